"""``sparsestreet evaluate run=RUN``: measure a trained run again."""

import sys
from pathlib import Path

import torch

from sparsestreet.cli.assemble import data_of, this_command
from sparsestreet.cli.compose import load_run_config
from sparsestreet.cli.scene import open_scene
from sparsestreet.evaluation.history import draw_history
from sparsestreet.evaluation.records import RunDescription, read_run, run_path, summary_path
from sparsestreet.evaluation.run import evaluate_scene

USAGE = """\
sparsestreet evaluate run=RUN [device=cpu|cuda]

RUN is a folder that train wrote, also of a run that was interrupted. Its scene is measured against the views of its
log, on the kind of device that it was trained on unless another is named; records and pictures are made anew, what is
said about the training stays.
"""


def evaluate(arguments: list[str]) -> int:
    """Open the run's scene and its log, write records and pictures; 2 on wrong usage, 1 where it cannot be read."""
    given = dict(text.split("=", 1) for text in arguments if "=" in text)
    if "--help" in arguments:
        print(USAGE)
        return 0
    if "run" not in given or set(given) - {"run", "device"}:
        print(USAGE, file=sys.stderr)
        return 2
    try:
        return _evaluate(Path(given["run"]), given.get("device"))
    except (FileNotFoundError, ValueError) as error:
        print(f"sparsestreet evaluate: {error}", file=sys.stderr)
        return 1


def _evaluate(run: Path, device: str | None) -> int:
    cfg, description = load_run_config(run), read_run(run_path(run))
    stored = open_scene(run, "cpu")
    data = data_of(cfg)
    summary = evaluate_scene(
        stored.scene,
        data.split.held_out,
        data.split.train,
        run=description,
        options=stored.options,
        out=run,
        command=this_command(["evaluate", f"run={run}"]),
        device=_device(description, device),
    )
    draw_history(run)
    for split, quality in summary.quality.items():
        print(f"{split.replace('_', '-')} views: {quality['psnr_full'].mean:.2f} dB")
    print(f"{summary.gaussians_total:,} Gaussians, {summary.latency.p50:.1f} ms/frame; records in {summary_path(run)}")
    return 0


def _device(description: RunDescription, device: str | None) -> torch.device:
    """The one that is asked for, else of the kind that trained. Raises ValueError where that is not there."""
    wanted = torch.device(device or description.device.partition(":")[0])
    if wanted.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            f"the run was trained on {description.device} and torch sees no CUDA device here: its milliseconds would "
            "be another machine's; say device=cpu to measure on the CPU all the same"
        )
    return wanted
