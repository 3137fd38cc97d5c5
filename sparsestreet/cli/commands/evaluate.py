"""``sparsestreet evaluate run=RUN``: measure a trained run again."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from omegaconf import OmegaConf

from sparsestreet.cli.commands.options import run_command
from sparsestreet.cli.commands.scenes import open_scene
from sparsestreet.cli.config.targets import made, open_run_config
from sparsestreet.cli.config.validate import device_of, type_problem
from sparsestreet.cli.runs.run import data_of, this_command
from sparsestreet.cli.runs.tracks import check_objects, finds
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.naming import printable
from sparsestreet.records.run import RUN, RunDescription, this_machine
from sparsestreet.report.result import result_lines
from sparsestreet.training.run import evaluate as evaluate_run

USAGE = """\
sparsestreet evaluate RUN [device=cpu|cuda] [novel=1,2,3] [ramp=true] [presets=fast,default,exact]

RUN is a folder that train wrote, also of a run that was interrupted. Its scene is measured against the views of its
log, on the kind of device that it was trained on unless another is named, with as many threads as trained it; records
and pictures are made anew, what is said about the training stays.

With novel, the held-out cameras are also shifted by so many meters to both sides, and compared with the real images
and, on synthetic streets, with the truth; with ramp the shift grows over the drive, as in a change of lane.
records/novel.json holds what was found.

With presets (names of render.preset), the same views are also rendered in these ways, whatever training did: what it
costs and saves is in records/presets.json, and in the report of the run's sweep.

A run with parts from outside (docs/extending.md) opens with parts=[MODULE], if their code is trusted.

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
    training_lpips: bool | None = None
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self.extra(ExtraMetrics())

    def extra(self, of_run: ExtraMetrics) -> ExtraMetrics:
        """What is asked for, else what the run's configuration asks for."""
        asked = {name: getattr(self, name) for name in ("novel", "ramp", "presets", "training_lpips")}
        return replace(of_run, **{name: value for name, value in asked.items() if value is not None})


def evaluate(arguments: list[str]) -> int:
    """Open the run's scene and its log, write records and pictures; statuses as in ``run_command``."""
    return run_command("evaluate", USAGE, arguments, Options, measure, positional=("run",))


def measure(options: Options) -> None:
    """Write records and pictures of a run anew, and say what they show.

    Raises ValueError, OSError or ImportError where something is missing or malformed.
    """
    run = options.run
    cfg, description = open_run_config(run, options.parts), RUN.read(run)
    if "evaluation" not in cfg:
        raise ValueError(f"{run} is of an earlier version, its configuration lacks 'evaluation': train it again")
    for part in (cfg.evaluation, cfg.data.log):
        if problem := type_problem(OmegaConf.to_container(part, resolve=True)):
            raise ValueError(f"{run}: {problem}")
    # The milliseconds of a run are those of one number of threads, and never of more than there are cores.
    torch.set_num_threads(min(description.threads, this_machine().cores))
    extra = options.extra(made(cfg.evaluation))
    stored = open_scene(run, "cpu", options.parts)
    data = data_of(cfg, run)
    if finds(cfg, data.driving_log):
        check_objects(stored.scene, data.driving_log)
    summary = evaluate_run(
        stored.scene,
        stored.options,
        data,
        run,
        device=_device(description, options.device),
        command=this_command(["evaluate", f"run={run}", *extra_words(extra)]),
        extra=extra,
        say=print,
    )
    print(printable("\n".join(result_lines(summary, run))))


def extra_words(extra: ExtraMetrics) -> list[str]:
    """What asks this command for these metrics."""
    novel = [f"novel={','.join(f'{offset:g}' for offset in extra.novel)}"] if extra.novel else []
    ramp = ["ramp=true"] if extra.ramp else []
    presets = [f"presets={','.join(extra.presets)}"] if extra.presets else []
    return [*novel, *ramp, *presets, *(["training_lpips=true"] if extra.training_lpips else [])]


def _device(description: RunDescription, device: str | None) -> torch.device:
    """The one that is asked for, else of the kind that trained."""
    asker = f"device={device}" if device else f"a run that was trained on {description.device}"
    remedy = "its milliseconds would be another machine's; say device=cpu to measure on the CPU all the same"
    return device_of(device or description.device.partition(":")[0], asker, remedy)
