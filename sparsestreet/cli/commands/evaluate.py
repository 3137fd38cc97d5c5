"""``sparsestreet evaluate run=RUN``: measure a trained run again."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.commands.options import run_command
from sparsestreet.cli.commands.scenes import open_scene
from sparsestreet.cli.config.targets import made, open_run_config
from sparsestreet.cli.config.validate import device_of, type_problem
from sparsestreet.cli.runs.locks import sole_writer
from sparsestreet.cli.runs.run import data_of, this_command
from sparsestreet.cli.runs.tracks import check_objects, finds
from sparsestreet.evaluation.extra import ExtraMetrics, time_again
from sparsestreet.evaluation.speed import device_name
from sparsestreet.naming import printable
from sparsestreet.records.run import FAILURE, RUN, RunDescription, this_machine, this_source
from sparsestreet.records.summary import HELD_OUT, SUMMARY
from sparsestreet.report.result import result_lines
from sparsestreet.report.tables import frames_steady
from sparsestreet.scene.storage import views_of
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

sparsestreet evaluate DIR only=speed [again=true] [device=cpu|cuda]

DIR is a sweep, or one run. The frames of all its finished runs are timed, one run after the other, as on a machine that
does nothing else; what the records say of times and their noise is renewed, all else stays. Runs that were timed so on
this machine by this commit are left out, so that the same command goes on where it ended; again=true times them too.

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
    only: Literal["speed"] | None = None
    again: bool = False
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        extra = self.extra(ExtraMetrics())
        if self.only and extra != ExtraMetrics():
            raise ValueError(f"only=speed times frames and nothing else: leave out {' '.join(extra_words(extra))}")
        if self.again and not self.only:
            raise ValueError("again=true is for only=speed: an evaluation always measures again")

    def extra(self, of_run: ExtraMetrics) -> ExtraMetrics:
        """What is asked for, else what the run's configuration asks for."""
        asked = {name: getattr(self, name) for name in ("novel", "ramp", "presets", "training_lpips")}
        return replace(of_run, **{name: value for name, value in asked.items() if value is not None})


def evaluate(arguments: list[str]) -> int:
    """Open the run's scene and its log, write records and pictures; statuses as in ``run_command``."""
    return run_command("evaluate", USAGE, arguments, Options, _act, positional=("run",))


def _act(options: Options) -> None:
    (time_runs if options.only else measure)(options)


def measure(options: Options) -> None:
    """Write records and pictures of a run anew, and say what they show.

    Raises ValueError, OSError or ImportError where something is missing or malformed.
    """
    run = options.run
    cfg, description = _opened(run, options)
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


def _opened(run: Path, options: Options) -> tuple[DictConfig, RunDescription]:
    """The configuration of a run and what it is, with as many threads as trained it."""
    cfg, description = open_run_config(run, options.parts), RUN.read(run)
    if "evaluation" not in cfg:
        raise ValueError(f"{run} is of an earlier version, its configuration lacks 'evaluation': train it again")
    for part in (cfg.evaluation, cfg.data.log):
        if problem := type_problem(OmegaConf.to_container(part, resolve=True)):
            raise ValueError(f"{run}: {problem}")
    # The milliseconds of a run are those of one number of threads, and never of more than there are cores.
    torch.set_num_threads(min(description.threads, this_machine().cores))
    return cfg, description


def time_runs(options: Options) -> None:
    """Time the frames of every finished run in a folder, one run after the other, and say what was found.

    Raises what ``measure`` raises, and FileNotFoundError where no run is finished. Ends the program after Ctrl-C.
    """
    runs = [run for run in SUMMARY.runs(options.run) if not FAILURE.exists(run)]
    if not runs:
        raise FileNotFoundError(f"{options.run} holds no run that was measured: train there first")
    try:
        for number, run in enumerate(runs, start=1):
            print(f"{number} of {len(runs)}, {printable(run.resolve().name)}: {_time_run(run, options)}", flush=True)
    except KeyboardInterrupt:
        print("sparsestreet evaluate: stopped, timed runs stay: give the same command to go on", file=sys.stderr)
        raise SystemExit(130) from None


def _time_run(run: Path, options: Options) -> str:
    cfg, description = _opened(run, options)
    device, before = _device(description, options.device), SUMMARY.read(run)
    here = (this_source(), this_machine(), device_name(device), torch.get_num_threads())
    timed = before.timed
    if not options.again and timed and (timed.source, timed.machine, timed.device, timed.threads) == here:
        return f"{before.latency.p50:.2f} ms a frame, timed before"
    with sole_writer(run):
        stored, views = open_scene(run, "cpu", options.parts), views_of(run)
        after = time_again(
            run,
            stored.scene.to(device),
            views.held_out if before.main_split == HELD_OUT else views.training,
            stored.options,
            made(cfg.evaluation).timing,
            command=this_command(["evaluate", f"run={run}", "only=speed"]),
        )
    steady = "" if frames_steady(after) else ", on a machine that was not quiet"
    return f"{after.latency.p50:.2f} ms a frame ({before.latency.p50:.2f} before){steady}"


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
