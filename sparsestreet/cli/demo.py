"""``sparsestreet demo``: a street, trained plain and pruned, one table and pictures."""

import subprocess
import sys
import time
from pathlib import Path

from sparsestreet.cli.report import report
from sparsestreet.evaluation.compare import compare_runs
from sparsestreet.evaluation.records import read_summary, summary_path
from sparsestreet.scene.centers import node_legend

USAGE = "sparsestreet demo [key=value ...]    the overrides go to both trainings (schedule.max_steps=500, seed=1 ...)"
EXPERIMENTS = ("streetgs", "streetgs_ours")


def demo(arguments: list[str]) -> int:
    """Train both experiments on the synthetic street, print the table and name the pictures."""
    if "--help" in arguments:
        print(USAGE)
        return 0
    started = time.perf_counter()
    out = Path("outputs/demo")
    for experiment in EXPERIMENTS:
        print(f"\n== {experiment} ==", flush=True)
        overrides = [f"experiment={experiment}", f"hydra.run.dir={out / experiment}", *arguments]
        # A process each: what one training leaves in memory does not slow the next.
        status = subprocess.run([sys.executable, "-m", "sparsestreet", "train", *overrides], check=False).returncode
        if status:
            return status
    plain, ours = (out / experiment for experiment in EXPERIMENTS)
    legend = node_legend(read_summary(summary_path(plain)).gaussians)
    compare_runs(plain, ours, out / "comparison.png", legend=legend)
    status = report([str(out), f"baseline={EXPERIMENTS[0]}", f"markdown={out / 'table.md'}"])
    print(f"pictures: {out}/comparison.png, {ours}/pictures/sheet.png ({time.perf_counter() - started:.0f} s in all)")
    return status
