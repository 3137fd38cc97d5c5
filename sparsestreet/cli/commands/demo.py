"""``sparsestreet demo``: a street, trained plain, with the paper's method and with ours; one table and pictures."""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from sparsestreet.cli.commands.report import report
from sparsestreet.cli.config.compose import quoted
from sparsestreet.records.summary import SUMMARY, RunSummary
from sparsestreet.report.run_comparison import compare_runs
from sparsestreet.report.tables import BUSY, busy_note, frames_steady, training_steady
from sparsestreet.scene.rendering import node_legend

USAGE = """\
sparsestreet demo [out=DIR] [key=value ...]

Trains the embedded street three times, in folders of outputs/demo (or of DIR): plain, sparsify=paper_short (both stages
of the paper, with numbers for short runs) and sparsify=removal (the paper's masks, then our rule). What is there of an
earlier demo is replaced. All other overrides go to all three: seed=1, schedule.max_steps=2000 ... Without data=... the
street is small: 30 frames of two cameras of 240x144 pixels, and at most 70,000 Gaussians in the background.
"""
OUT = Path("outputs/demo")
SPARSIFY = {"none": "plain", "paper_short": "the paper's method (short)", "removal": "ours"}
"""Sparsification -> what it is called where nobody has read the glossary."""
ASSIGNMENT = "all_rigid"
"""Whoever walks or rides is on a track too, as a figure that keeps its shape: method=omnire takes longer."""
STEPS = 800
SMALL = [
    *(f"data.log.settings.{name}" for name in ("width=240", "height=144", "num_frames=30", "num_cameras=2")),
    "capacity.background.max_gaussians=70000",
]
"""With so many steps, three runs, their pictures and the setting-up in three to four minutes on two cores; a run of
one's own takes 2,000 steps on 40 frames of three cameras of 320x192, and up to 130,000 Gaussians in the background."""


def demo(arguments: list[str]) -> int:
    """Train on the synthetic street, print the table and name the pictures."""
    if "--help" in arguments:
        print(USAGE)
        return 0
    try:
        out, arguments = _folder(arguments)
    except ValueError as error:
        print(f"sparsestreet demo: {error}", file=sys.stderr)
        return 2
    started = time.perf_counter()
    logs = {text.partition("=")[2] for text in arguments if text.partition("=")[0].lstrip("+") == "data"}
    small = () if logs - {"synthetic"} else SMALL
    for sparsify in SPARSIFY:
        print(f"\n== sparsify={sparsify} ==", flush=True)
        chosen = [f"sparsify={sparsify}", f"assignment={ASSIGNMENT}", f"schedule.max_steps={STEPS}", "overwrite=true"]
        overrides = [*chosen, *small, f"out={quoted(str(out / sparsify))}", *arguments]
        # A process each: what one training leaves in memory does not slow the next.
        status = subprocess.run([sys.executable, "-m", "sparsestreet", "train", *overrides], check=False).returncode
        if status < 0:
            print(f"sparsestreet demo: signal {-status} ended the training of {out / sparsify}", file=sys.stderr)
        if status:
            return status if status > 0 else 128 - status
    runs = [out / sparsify for sparsify in SPARSIFY]
    plain = SUMMARY.read(runs[0])
    titles = list(SPARSIFY.values())
    compare_runs(runs, out / "comparison.png", legend=node_legend(plain.gaussians), titles=titles)
    status = report([f"sweep={out}"])
    _print_comparison([SUMMARY.read(run) for run in runs])
    took = f"{time.perf_counter() - started:.0f} s in all"
    print(f"all tables and pictures, in a browser: {out}/report/index.html ({took})")
    print(f"pictures: {out}/comparison.png, {runs[-1]}/pictures/sheet.png")
    print(f"a video of it: sparsestreet render scene={runs[-1]} path=shifted offset=1.5 out=drive.mp4")
    return status


def _print_comparison(runs: Sequence[RunSummary]) -> None:
    """Print the one table that the demo is about, last of all: a column a run."""
    busy = [[BUSY * (not steady(run)) for run in runs] for steady in (frames_steady, training_steady)]
    rows = {
        "held-out PSNR, dB": [_text(run.mean("psnr_full"), ".2f") for run in runs],
        "Gaussians": [f"{run.gaussians_total:,}" for run in runs],
        "MB": [f"{run.bytes_total / 1e6:.2f}" for run in runs],
        "ms a frame": [f"{run.latency.p50:.1f} {mark}".rstrip() for run, mark in zip(runs, busy[0], strict=True)],
        "seconds of training": [
            f"{_text(run.run.training_seconds, '.0f')} {mark}".rstrip() for run, mark in zip(runs, busy[1], strict=True)
        ],
    }
    table = Table()
    for heading in ("", *SPARSIFY.values()):
        table.add_column(heading, justify="right" if heading else "left")
    for name, cells in rows.items():
        table.add_row(name, *cells)
    console = Console()
    console.print(table)
    for note in busy_note(zip(SPARSIFY.values(), runs, strict=True)):
        console.print(Text(note))


def _text(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _folder(arguments: Sequence[str]) -> tuple[Path, list[str]]:
    """The demo's folder, and the overrides of all three runs.

    Raises ValueError for what would make one run of the three, or lead them into one folder.
    """
    for text in arguments:
        key = text.partition("=")[0].lstrip("+")
        if key in ("sparsify", "folder", "resume", "hydra.run.dir") or text in ("-m", "--multirun"):
            raise ValueError(f"{text}: the demo trains plain, paper and removal, in folders of out=DIR: leave it out")
    places = [text.partition("=")[2].strip("'\"") for text in arguments if text.startswith("out=")]
    if len(places) > 1 or "" in places:
        raise ValueError("out=DIR names one folder, or is left out")
    return Path(places[0]) if places else OUT, [text for text in arguments if not text.startswith("out=")]
