"""A sweep's folder as training leaves it, with numbers that tests choose."""

from pathlib import Path

import numpy as np

from sparsestreet.pictures.images import KINDS, picture_path, write_png
from sparsestreet.records.costs import NodeCost, update_costs
from sparsestreet.records.curves import HELD_OUT_CURVE, LEDGER, CountChange, HeldOutLook
from sparsestreet.records.run import FAILURE, FailedRun
from sparsestreet.records.summary import SUMMARY, RunSummary
from sparsestreet.report.collect import RunRecord
from tests.evaluation.frames import make_summary
from tests.typed import there

LOSSES = {0: 0.2, 1: 0.3, 2: 0.4}
"""Seed -> dB that pruning costs."""


def record(summary: RunSummary, folder: str = "run") -> RunRecord:
    return RunRecord(Path(folder), summary)


def street_runs() -> dict[str, RunSummary]:
    """Name of a folder -> record: a plain method, one pruned to a quarter, and a control, on three streets."""
    found = {}
    for seed, loss in LOSSES.items():
        scene = f"street {seed}"
        plain = {"background": 8000, "rigid": 2000}
        small = {"background": 2000, "rigid": 500 + 10 * seed}
        runs = {
            "streetgs": make_summary("streetgs", seed, 25.0 + seed, plain, scene=scene),
            "streetgs+removal": make_summary(
                "streetgs+removal", seed, 25.0 + seed - loss, small, scene=scene, milliseconds=10.0
            ),
            # Its count is that of the pruned run, so that its configuration is another one for each seed.
            "streetgs+random": make_summary(
                "streetgs+random", seed, 23.0 + seed, small, scene=scene, milliseconds=10.0,
                config={"count_of": f"../{seed}", "callback.pruning.rule.keep.rigid": 500 + 10 * seed},
            ),
        }  # fmt: skip
        found |= {f"{name}_seed{seed}": run for name, run in runs.items()}
    return found


def write_sweep(folder: Path, *, curves: bool = True, failed: bool = True) -> Path:
    """All files that the report reads."""
    for name, summary in street_runs().items():
        run = folder / name
        SUMMARY.write(run, summary)
        LEDGER.write(run, _ledger(summary))
        for kind in KINDS:
            image = np.full((30, 48, 3), 40 + 60 * KINDS.index(kind), dtype=np.uint8)
            write_png(picture_path(run / "pictures", 5, 0, kind), image)
        if curves:
            _write_curve(run, there(summary.mean("psnr_full")))
            nodes = {name: NodeCost(10, 0.1, 4.0, ms) for name, ms in (("background", 3.0), ("rigid", 1.0))}
            steps = {"scene": 1.0, "splat": 2.0, "sky": 0.5, "losses": 0.25, "regularizers": 0.125}
            steps |= {"backward": 4.0, "optimizer": 0.5}
            update_costs(run, nodes=nodes, effects={"sky": 0.5}, step_ms=steps, phases={"train": 9.0, "prune": 0.25})
    if failed:
        failure = FailedRun(label="streetgs+paper", seed=0, command="train x", error="no <memory>", trace="Trace ...")
        FAILURE.write(folder / "streetgs+paper_seed0", failure)
    return folder


def _ledger(summary: RunSummary) -> list[CountChange]:
    return [
        CountChange(0, "background", 0, 8000, "start"),
        CountChange(40, "background", 8000, summary.gaussians["background"], "pruning"),
    ]


def _write_curve(run: Path, end: float) -> None:
    drops = enumerate((3.0, 0.8, 0.3, 0.0), start=1)
    HELD_OUT_CURVE.write(run, [HeldOutLook(10.0 * step, step, end - drop, 20.0, None) for step, drop in drops])
