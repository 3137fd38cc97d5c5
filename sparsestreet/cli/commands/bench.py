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

Mode = Literal["settings", "blend", "step", "costs", "scaling"]

COSTS_STREET = (
    "data.log.settings.width=96",
    "data.log.settings.height=64",
    "data.log.settings.num_frames=8",
)
"""A street of which every effect can be built; what they cost is measured on another."""

USAGE = """\
sparsestreet bench [MODE] [key=value ...]     what the splat op costs in time, memory and accuracy

  sparsestreet bench                            settings of the op, on five scenes; the street is made of numbers
  sparsestreet bench quick=true                 the same at sizes that take a minute or two: to see that it runs
  sparsestreet bench settings street=RUN        the street of a run that train wrote; its exact images take minutes
  sparsestreet bench blend                      stages of the C++ backend beside vectorized torch, and the floor
  sparsestreet bench step                       phases of a training step: time, operations, distance to their floors
  sparsestreet bench step sparsify=paper        the same of another training: options as those of train
  sparsestreet bench costs street=RUN           what each effect adds to a frame of a trained street, beside the plan's
  sparsestreet bench scaling threads=2          time against pairs, 1,000 to 3,000,000 splats, and a straight line

  mode      settings, blend, step, costs or scaling (default: settings); a word without a key
  quick     true: tiny sizes and few repeats, whose times mean little
  street    settings, costs: the folder of a trained run
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
        if self.street is not None and self.mode not in ("settings", "costs"):
            raise ValueError(f"street=RUN is for the modes settings and costs, got {self.mode}: leave it out")
        if self.street is None and self.mode == "costs":
            raise ValueError("costs measures a trained street: name the folder of its run with street=RUN")


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
        file = record_file(request.out, request.mode, command)
        {"settings": _settings, "blend": _blend, "costs": _costs, "scaling": _scaling}[request.mode](request, file)
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


def _blend(request: BenchRequest, file: "RecordFile") -> None:
    from sparsestreet.bench import blend
    from sparsestreet.bench.scenes import Size
    from sparsestreet.bench.timing import ONCE, TimingBudget

    if request.quick:
        blend.run_blend(Size(64, 48, 300), [Size(48, 32, 200)], ONCE, ONCE, file)
    else:
        blend.run_blend(blend.MAIN, blend.TRAINING, TimingBudget(), TimingBudget(repeats=3), file)


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


def _costs(request: BenchRequest, file: "RecordFile") -> None:
    from sparsestreet.bench import costs
    from sparsestreet.bench.scenes import Size
    from sparsestreet.bench.timing import ONCE, TimingBudget
    from sparsestreet.cli.commands.effects import known_effects

    assert request.street is not None, "checked by BenchRequest"
    stored, view = _stored(request.street)
    street = costs.Street(dict(stored.scene.nodes.items()), view)
    effects, data = known_effects(COSTS_STREET)
    if request.quick:
        costs.run_costs(effects, data, street, (1.0, 0.5), (Size(48, 32, 200),), ONCE, file)
    else:
        costs.run_costs(effects, data, street, costs.SCALES, costs.PROXIES, TimingBudget(60, 60.0), file)


def _scaling(request: BenchRequest, file: "RecordFile") -> None:
    from sparsestreet.bench import scaling
    from sparsestreet.bench.timing import ONCE, TimingBudget

    if request.quick:
        scaling.run_scaling((200, 400, 800), None, ONCE, file, request.out)
    else:
        scaling.run_scaling(scaling.ROWS, scaling.LARGE, TimingBudget(seconds=15.0, least=5), file, request.out)


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
