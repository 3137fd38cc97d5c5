"""``sparsestreet bench``: what the splat op, a training step and its frames cost in time, memory and accuracy."""

import argparse
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from sparsestreet.bench.records import Provenance, RecordFile
from sparsestreet.bench.scenes import BenchScene, Size
from sparsestreet.cli.config.validate import override_problem
from sparsestreet.records.provenance import this_machine, this_source

if TYPE_CHECKING:
    from torch import Tensor

    from sparsestreet.data.synthetic.settings import StreetSettings
    from sparsestreet.scene.storage import StoredScene
    from sparsestreet.types import View

COSTS_STREET = (
    "data.log.settings.width=96",
    "data.log.settings.height=64",
    "data.log.settings.num_frames=8",
)
"""A street of which every effect can be built; what they cost is measured on another."""

EXAMPLES = """\
examples:
  sparsestreet bench                            knobs, on five scenes; the street is a proxy scene made of numbers
  sparsestreet bench knobs --street RUN         the street of a run that train wrote; its exact images take minutes
  sparsestreet bench knobs --quick              the same at sizes that take a minute or two: to see that it runs
  sparsestreet bench blend                      stages of the C++ backend beside vectorized torch, and the floor
  sparsestreet bench step                       phases of a training step: time, operations, distance to their floors
  sparsestreet bench step sparsify=paper        the same of another training: options as those of train
  sparsestreet bench data                       what a step waits for its frame beside a device of 5 ms a step
  sparsestreet bench masks                      a mask over time: its network a frame, and the bits that it leaves
  sparsestreet bench effects                    effects planted in streets of ten seeds: what plans see; --quick: one
  sparsestreet bench costs --street RUN         what each effect adds to a frame of a trained street, beside the plan's
  sparsestreet bench edits --street RUN         objects removed, moved, copied, beside a street traced that way
  sparsestreet bench edits --street RUN --other RUN     and objects of another street inserted, beside its trace
  sparsestreet bench serve --street RUN         the render server: latency, memory, wrong requests, objects it places
  sparsestreet bench scaling --threads 2        time against pairs, 1,000 to 3,000,000 splats, and a straight line
  sparsestreet bench gpu                        a CUDA device at 0.1 to 5 M splats; beside it gsplat, if installed
  sparsestreet bench gpu --street RUN --refine 3   and a trained street, each splat as 3 x 3, the image 3 times as wide
  sparsestreet bench gpu --street RUN --enlarge 2  that street alone, also in images twice as wide
  sparsestreet bench gpu --tuning most_parts=1 --tuning two_launches=false   and other choices of the kernels

Records go to OUT/MODE.jsonl, one JSON object a line; figures beside them as SVG and PNG.
"""


def bench(arguments: list[str]) -> int:
    """Run one mode (knobs unless another is named); 0 if all went well, 1 if a renderer failed."""
    modes: dict[str, Callable[[argparse.Namespace], bool]] = {
        "knobs": _knobs,
        "blend": _blend,
        "step": _step,
        "data": _data,
        "masks": _masks,
        "effects": _effects,
        "costs": _costs,
        "edits": _edits,
        "serve": _serve,
        "scaling": _scaling,
        "gpu": _gpu,
    }
    parser = _parser(list(modes))
    options = parser.parse_intermixed_args(arguments)
    if options.overrides and options.mode != "step":
        parser.error(f"{options.mode} takes no options of train, got {' '.join(options.overrides)}")
    if options.refine is not None and (options.mode != "gpu" or options.street is None or options.refine < 1):
        parser.error("--refine N, at least 1, makes the street of gpu --street RUN finer")
    if options.enlarge is not None and (options.mode != "gpu" or options.street is None or options.enlarge < 1):
        parser.error("--enlarge N, at least 1, shows the street of gpu --street RUN alone, in larger images too")
    if options.tuning and options.mode != "gpu":
        parser.error("--tuning compares choices of the kernels of gpu")
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    options.command = shlex.join(["sparsestreet", "bench", *arguments])
    return 0 if modes[options.mode](options) else 1


def _parser(modes: list[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sparsestreet bench",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("mode", nargs="?", default="knobs", choices=modes, help="what to measure (default: knobs)")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="step: options of train")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="tiny sizes, few repeats: a minute or two of one core, and of knobs "
        "half a minute more for each tile size, compiled into .cache/tiles of the checkout; its times mean little",
    )
    parser.add_argument(
        "--street", type=Path, metavar="RUN", help="knobs, gpu, edits, serve: the trained street of this run's folder"
    )
    parser.add_argument(
        "--other", type=Path, metavar="RUN", help="edits: a run on another synthetic street, whose objects are inserted"
    )
    parser.add_argument(
        "--refine", type=int, metavar="N", help="gpu: N x N smaller splats for each of the street's, N times the image"
    )
    parser.add_argument(
        "--enlarge", type=int, metavar="N", help="gpu: the street alone, also in images N times as large a side"
    )
    parser.add_argument(
        "--tuning", action="append", default=[], metavar="NAME=VALUE,...",
        help="gpu: other choices of the kernels beside today's (ops/triton/tuning.py); once for each",
    )  # fmt: skip
    parser.add_argument("--threads", type=int, help="threads of the CPU (default: as torch finds them)")
    parser.add_argument("--out", type=Path, default=Path("outputs/bench"), help="folder for records and figures")
    return parser


def _knobs(options: argparse.Namespace) -> bool:
    from sparsestreet.bench import figures, knobs, sweep
    from sparsestreet.bench.records import read_records
    from sparsestreet.bench.scenes import bench_scenes

    street = None if options.street is None else trained_street(options.street)
    size = sweep.QUICK if options.quick else sweep.FULL
    file = _file(options)
    sweep.run_sweep(
        bench_scenes(size, street),
        bench_scenes(sweep.SMALL),
        knobs.points(),
        sweep.QUICK_BUDGET if options.quick else sweep.BUDGET,
        file,
    )
    for path in figures.draw_pareto(read_records(file.path), options.out):
        print(f"drawn: {path}")
    return True


def _blend(options: argparse.Namespace) -> bool:
    from sparsestreet.bench import blend
    from sparsestreet.bench.timing import TimingBudget

    if options.quick:
        once = TimingBudget(repeats=2, least=1)
        blend.run_blend(Size(64, 48, 300), [Size(48, 32, 200)], once, once, _file(options))
    else:
        blend.run_blend(blend.MAIN, blend.TRAINING, TimingBudget(), TimingBudget(repeats=3), _file(options))
    return True


def _step(options: argparse.Namespace) -> bool:
    from tempfile import TemporaryDirectory

    from sparsestreet.bench import step
    from sparsestreet.cli.runs.run import train_with

    problem = override_problem(options.overrides)
    if problem:
        raise SystemExit(f"sparsestreet bench step: {problem}")
    window = step.QUICK if options.quick else step.FULL
    with TemporaryDirectory() as folder:
        train = train_with(options.overrides, Path(folder))
        step.run_step(" ".join(["train", *options.overrides]), train, window, _file(options), options.out)
    return True


def _data(options: argparse.Namespace) -> bool:
    from sparsestreet.bench import data

    data.run_data(data.QUICK if options.quick else data.FULL, options.out, _file(options))
    return True


def _effects(options: argparse.Namespace) -> bool:
    from sparsestreet.bench import planted
    from sparsestreet.cli.commands.effects import planned

    planted.run_planted(planned, range(1 if options.quick else 10), _file(options))
    return True


def _costs(options: argparse.Namespace) -> bool:
    from sparsestreet.bench import costs
    from sparsestreet.bench.timing import TimingBudget
    from sparsestreet.cli.commands.effects import known_effects

    if options.street is None:
        raise SystemExit("sparsestreet bench costs: name the folder of a trained run with --street RUN")
    stored, view = _stored(options.street)
    street = costs.Street(dict(stored.scene.nodes.items()), view)
    effects, data = known_effects(COSTS_STREET)
    if options.quick:
        once = TimingBudget(repeats=2, least=1)
        costs.run_costs(effects, data, street, (1.0, 0.5), (Size(48, 32, 200),), once, _file(options))
    else:
        costs.run_costs(effects, data, street, costs.SCALES, costs.PROXIES, TimingBudget(60, 60.0), _file(options))
    return True


def _edits(options: argparse.Namespace) -> bool:
    from sparsestreet.bench import edits, edits_insert
    from sparsestreet.scene.storage import load_scene

    if options.street is None:
        raise SystemExit("sparsestreet bench edits: --street RUN names a run on a synthetic street")
    if (traced := _traced(options.street, options.quick)) is None:
        raise SystemExit(f"sparsestreet bench edits: {options.street} was not trained on a synthetic street")
    views, settings, street_from_world = traced
    stored, file = load_scene(options.street), _file(options)
    count = edits.run_edits(stored, views, settings, street_from_world, file)
    if options.other is not None:
        if (foreign := _traced(options.other, options.quick)) is None:
            raise SystemExit(f"sparsestreet bench edits: {options.other} was not trained on a synthetic street")
        street = edits_insert.TracedStreet(stored, settings, street_from_world)
        other = edits_insert.TracedStreet(load_scene(options.other), *foreign[1:])
        count += edits_insert.run_inserts(street, other, views, file)
    return count > 0


def _traced(run: Path, quick: bool) -> "tuple[list[View], StreetSettings, Tensor] | None":
    """Held-out views of a run, and how its street can be traced with other actors; None for a recorded drive."""
    from sparsestreet.cli.config.compose import check_moved
    from sparsestreet.cli.config.log_from_options import reader_of
    from sparsestreet.cli.config.targets import open_run_config
    from sparsestreet.data.lazy import spread
    from sparsestreet.data.synthetic import StreetReader
    from sparsestreet.scene.views import FILE_NAME, read_views

    try:
        config = open_run_config(run)
        check_moved(config)
        reader = reader_of(config)
    except (OSError, ValueError) as error:
        raise SystemExit(f"sparsestreet bench: {error}") from error
    if not isinstance(reader, StreetReader):
        return None
    views = read_views(run / FILE_NAME).held_out
    chosen = [views[place] for place in spread(len(views), 4 if quick else 24)]
    return chosen, reader.settings, reader.read().dataset_from_world


def _masks(options: argparse.Namespace) -> bool:
    from sparsestreet.bench import masks
    from sparsestreet.bench.timing import TimingBudget

    sizes, budget = ((100,), TimingBudget(repeats=2, least=1)) if options.quick else (masks.ROWS, TimingBudget(100))
    masks.run_masks(sizes, masks.FRAMES, budget, _file(options))
    return True


def _serve(options: argparse.Namespace) -> bool:
    if options.street is None:
        raise SystemExit("sparsestreet bench serve: --street RUN names the folder of a trained run")
    try:
        from sparsestreet.bench import serve, serve_client, serve_placed
    except ModuleNotFoundError as error:
        raise SystemExit(f"sparsestreet bench serve needs {error.name}: pip install 'sparsestreet[serve]'") from error
    file = _file(options)
    good = serve.run_serve(options.street, serve.QUICK if options.quick else serve.FULL, file)
    traced = _traced(options.street, options.quick)
    if traced is None:
        print("the street is no synthetic one: objects that a request places are compared with nothing")
        return good
    with serve_client.server(options.street, workers=1) as (client, _):
        serve_placed.run_placed(client, *traced, file)
    return good


def _scaling(options: argparse.Namespace) -> bool:
    from sparsestreet.bench import scaling
    from sparsestreet.bench.timing import TimingBudget

    file = _file(options)
    if options.quick:
        scaling.run_scaling((200, 400, 800), None, TimingBudget(repeats=2, least=1), file, options.out)
    else:
        scaling.run_scaling(scaling.ROWS, scaling.LARGE, TimingBudget(seconds=15.0, least=5), file, options.out)
    return True


def _gpu(options: argparse.Namespace) -> bool:
    from sparsestreet.bench import gpu
    from sparsestreet.bench.timing import TimingBudget
    from sparsestreet.bench.tunings import tuning_of

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if device.type == "cpu" and not options.quick:
        raise SystemExit("sparsestreet bench gpu: no CUDA device is available; --quick runs it on the CPU, tiny")
    try:
        tunings = gpu.DEFAULT | {words: tuning_of(words) for words in options.tuning}
    except ValueError as error:
        raise SystemExit(f"sparsestreet bench gpu: {error}") from error
    streets = [] if options.street is None else front_streets(options.street, options.refine or 1, options.enlarge or 1)
    if options.quick:
        once = TimingBudget(repeats=2, least=1)
        sizes = [] if options.enlarge else [Size(64, 48, 500)]
        return gpu.run_gpu(sizes, device, once, _file(options), streets=streets, tunings=tunings)
    images = [] if options.enlarge else gpu.IMAGES
    sizes = [Size(width, height, rows) for width, height in images for rows in gpu.ROWS]
    return gpu.run_gpu(sizes, device, gpu.BUDGET, _file(options), streets=streets, tunings=tunings)


def front_streets(run: Path, refine: int, enlarge: int = 1) -> list[BenchScene]:
    """A trained run as its camera of the least number sees it in its first and in its middle frame, refined.

    With ``enlarge`` above 1 both come once more, in images that are as many times as wide and high.

    Raises FileNotFoundError if the folder holds no scene or no views.
    """
    from sparsestreet.bench.refine import enlarged, refined

    stored, views = _scene_and_views(run)
    front = [view for view in views if view.camera_index == min(view.indices[1] for view in views)]
    chosen = {place: front[place] for place in (0, len(front) // 2)}
    streets = [refined(_street(run, stored, view), refine) for view in chosen.values()]
    return streets if enlarge == 1 else [*streets, *(enlarged(street, enlarge) for street in streets)]


def trained_street(run: Path) -> BenchScene:
    """A recorded view of a trained run, in the middle of its log, as ``evaluate`` would splat it.

    Raises FileNotFoundError if the folder holds no scene or no views.
    """
    return _street(run, *_stored(run))


def _street(run: Path, stored: "StoredScene", view: "View") -> BenchScene:
    with torch.no_grad():
        placed = stored.scene.gaussians_at(view)
    source = f"trained: {run.name} on {stored.name}, frame {view.frame_index}"
    return BenchScene("trained street", source, placed.gaussians, placed.view.camera)


def _stored(run: Path) -> "tuple[StoredScene, View]":
    stored, views = _scene_and_views(run)
    return stored, views[len(views) // 2]


def _scene_and_views(run: Path) -> "tuple[StoredScene, tuple[View, ...]]":
    from sparsestreet.scene.storage import load_scene
    from sparsestreet.scene.views import FILE_NAME, read_views

    return load_scene(run), read_views(run / FILE_NAME).all


def _file(options: argparse.Namespace) -> RecordFile:
    provenance = Provenance(options.command, torch.get_num_threads(), this_machine(), this_source())
    return RecordFile(options.out / f"{options.mode}.jsonl", provenance)
