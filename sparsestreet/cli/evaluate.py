"""``sparsestreet evaluate run=RUN``: measure a trained run again."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from hydra.utils import instantiate

from sparsestreet.cli.assemble import data_of, this_command
from sparsestreet.cli.compose import load_run_config
from sparsestreet.cli.options import run_command
from sparsestreet.cli.scene import open_scene
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.evaluation.run import evaluate_scene
from sparsestreet.pictures.history import draw_history
from sparsestreet.records.provenance import this_machine
from sparsestreet.records.run import RUN, RunDescription
from sparsestreet.records.summary import SUMMARY

USAGE = """\
sparsestreet evaluate run=RUN [device=cpu|cuda] [novel=1,2,3] [ramp=true] [presets=fast,default,exact]

RUN is a folder that train wrote, also of a run that was interrupted. Its scene is measured against the views of its
log, on the kind of device that it was trained on unless another is named, with as many threads as trained it; records
and pictures are made anew, what is said about the training stays.

With novel, the held-out cameras are also shifted by so many meters to both sides, and compared with the real images
and, on synthetic streets, with the truth; with ramp the shift grows over the drive, as in a change of lane.
records/novel.json holds what was found.

With presets (names of render.preset), the same views are also rendered in these ways, whatever training did: what it
costs and saves is in records/presets.json, and in the report of the run's sweep.

Training measures both by itself where evaluation.novel, ramp and presets ask for it; then so does this command.
"""


@dataclass(frozen=True)
class Options:
    """The words of the command."""

    run: Path
    device: Literal["cpu", "cuda"] | None = None
    novel: tuple[float, ...] | None = None
    ramp: bool | None = None
    presets: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        self.looks(ExtraMetrics())

    def looks(self, of_run: ExtraMetrics) -> ExtraMetrics:
        """What is asked for, else what the run's configuration asks for."""
        asked = {name: getattr(self, name) for name in ("novel", "ramp", "presets")}
        return replace(of_run, **{name: value for name, value in asked.items() if value is not None})


def evaluate(arguments: list[str]) -> int:
    """Open the run's scene and its log, write records and pictures; statuses as in ``run_command``."""
    return run_command("evaluate", USAGE, arguments, Options, _evaluate)


def _evaluate(options: Options) -> None:
    run = options.run
    cfg, description = load_run_config(run), RUN.read(run)
    if "evaluation" not in cfg:
        raise ValueError(f"{run} is of an earlier version, its configuration lacks 'evaluation': train it again")
    # The milliseconds of a run are those of one number of threads, and never of more than there are cores.
    torch.set_num_threads(min(description.threads, this_machine().cores))
    looks = options.looks(instantiate(cfg.evaluation, _convert_="all"))
    command = this_command(["evaluate", f"run={run}", *looks.words()])
    stored = open_scene(run, "cpu")
    data = data_of(cfg)
    summary = evaluate_scene(
        stored.scene,
        data.split.held_out,
        data.split.train,
        run=description,
        options=stored.options,
        out=run,
        command=command,
        device=_device(description, options.device),
    )
    draw_history(run)
    for split, quality in summary.quality.items():
        print(f"{split.replace('_', '-')} views: {quality['psnr_full'].mean:.2f} dB")
    latency = summary.latency
    steady = "" if latency.noise.quiet else " on a machine that was not quiet"
    print(f"{summary.gaussians_total:,} Gaussians, {latency.p50:.1f} ms/frame{steady}; records in {SUMMARY.path(run)}")
    looks.take(stored.scene, data, stored.options, out=run, command=command, say=print)


def _device(description: RunDescription, device: str | None) -> torch.device:
    """The one that is asked for, else of the kind that trained. Raises ValueError where that is not there."""
    wanted = torch.device(device or description.device.partition(":")[0])
    if wanted.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            f"the run was trained on {description.device} and torch sees no CUDA device here: its milliseconds would "
            "be another machine's; say device=cpu to measure on the CPU all the same"
        )
    return wanted
