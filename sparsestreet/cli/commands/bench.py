"""``sparsestreet bench``: what the splat op, a training step and its frames cost in time, memory and accuracy."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sparsestreet.cli.commands.options import OptionError, run_command

if TYPE_CHECKING:
    from sparsestreet.bench.records import RecordFile
    from sparsestreet.bench.scenes import BenchScene
    from sparsestreet.scene.storage import StoredScene
    from sparsestreet.types import View

Mode = Literal["settings", "step"]

USAGE = """\
sparsestreet bench [MODE] [key=value ...]     what the splat op costs in time, memory and accuracy

  sparsestreet bench                            settings of the op, on five scenes; the street is made of numbers
  sparsestreet bench quick=true                 the same at sizes that take a minute or two: to see that it runs
  sparsestreet bench settings street=RUN        the street of a run that train wrote; its exact images take minutes
  sparsestreet bench step                       phases of a training step: time, operations, distance to their floors
  sparsestreet bench step sparsify=paper        the same of another training: options as those of train

  mode      settings or step (default: settings); a word without a key
  quick     true: tiny sizes and few repeats, whose times mean little
  street    settings: the folder of a trained run
  threads   threads of the CPU (default: as torch finds them)
  out       folder for records and figures (default: outputs/bench)

Records go to OUT/MODE.jsonl, one JSON object a line, and figures beside them as SVG and PNG.
"""


@dataclass(frozen=True)
class BenchRequest:
    """The command's options. Raises ValueError where they do not fit the mode."""

    mode: Mode = "settings"
    quick: bool = False
    street: Path | None = None
    threads: int | None = None
    out: Path = Path("outputs/bench")

    def __post_init__(self) -> None:
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads is at least 1, got {self.threads}")
        if self.street is not None and self.mode != "settings":
            raise ValueError(f"street=RUN is for the mode settings, got {self.mode}: leave it out")


def bench(arguments: list[str]) -> int:
    """Run one mode, settings unless another is named; 2 on wrong usage, 1 if something is missing."""
    own = [field.name for field in fields(BenchRequest)]
    is_step = "step" in arguments or "mode=step" in arguments
    overrides = [word for word in arguments if is_step and "=" in word and word.partition("=")[0] not in own]
    words = [word for word in arguments if word not in overrides] or ["settings"]
    command = shlex.join(["sparsestreet", "bench", *arguments])
    return run_command("bench", USAGE, words, BenchRequest, partial(_bench, command, overrides), positional=("mode",))


def _bench(command: str, overrides: list[str], request: BenchRequest) -> None:
    import torch

    from sparsestreet.noise import calibrate, noise_between

    if request.threads is not None:
        torch.set_num_threads(request.threads)
    before = calibrate(torch.device("cpu"))
    if request.mode == "step":
        _step(request, overrides, command)
    else:
        _settings(request, record_file(request.out, request.mode, command))
    if not noise_between(before, calibrate(torch.device("cpu"))).quiet:
        print("the machine was not quiet: compare these times with no others")


def _settings(request: BenchRequest, file: "RecordFile") -> None:
    from sparsestreet.bench import figures, scenes, settings_sweep
    from sparsestreet.bench.records import read_records

    street = None if request.street is None else trained_street(request.street)
    settings_sweep.run_sweep(
        scenes.bench_scenes(settings_sweep.QUICK if request.quick else settings_sweep.FULL, street),
        scenes.bench_scenes(settings_sweep.SMALL),
        settings_sweep.points(),
        settings_sweep.QUICK_BUDGET if request.quick else settings_sweep.BUDGET,
        file,
    )
    for path in figures.draw_pareto(read_records(file.path), request.out):
        print(f"drawn: {path}")


def _step(request: BenchRequest, overrides: Sequence[str], command: str) -> None:
    from tempfile import TemporaryDirectory

    from sparsestreet.bench import step
    from sparsestreet.cli.config.validate import override_problem
    from sparsestreet.cli.runs.run import train_with

    problem = override_problem(list(overrides))
    if problem:
        raise OptionError(problem)
    file = record_file(request.out, request.mode, command)
    window = step.QUICK if request.quick else step.FULL
    with TemporaryDirectory() as folder:
        train = train_with(overrides, Path(folder))
        step.run_step(" ".join(["train", *overrides]), train, window, file, request.out)


def trained_street(run: Path) -> "BenchScene":
    """Return a recorded view of a trained run, in the middle of its log, as ``evaluate`` would splat it.

    Raises FileNotFoundError if the folder holds no scene or no views.
    """
    return street_at(run, *_stored(run))


def street_at(run: Path, stored: "StoredScene", view: "View") -> "BenchScene":
    """Return what one view sees of a trained run."""
    import torch

    from sparsestreet.bench.scenes import BenchScene

    with torch.no_grad():
        placed = stored.scene.gaussians_at(view)
    source = f"trained: {run.name} on {stored.name}, frame {view.frame_index}"
    return BenchScene("trained street", source, placed.gaussians, placed.view.camera)


def _stored(run: Path) -> "tuple[StoredScene, View]":
    stored, views = scene_and_views(run)
    return stored, views[len(views) // 2]


def scene_and_views(run: Path) -> "tuple[StoredScene, tuple[View, ...]]":
    """Return the scene and all recorded views of a run's folder, a scene file in it, or a .street."""
    from sparsestreet.scene.storage import load_scene, views_of

    return load_scene(run), views_of(run).all


def record_file(folder: Path, name: str, command: str) -> "RecordFile":
    """Return the file for the records of one command on this machine."""
    import torch

    from sparsestreet.bench.records import Provenance, RecordFile
    from sparsestreet.records.run import this_machine, this_source

    provenance = Provenance(command, torch.get_num_threads(), this_machine(), this_source())
    return RecordFile(folder / f"{name}.jsonl", provenance)
