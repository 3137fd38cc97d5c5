"""Errors of trained streets by the distance of what is seen, beside the path: ``python -m benchmarks.far_things``.

Views are those held out, as recorded and moved to both sides. The truth is the traced street with its depth. Squared
errors of all views are pooled before they become dB.
"""

import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from scipy.stats import t

from sparsestreet.bench.records import RecordFile
from sparsestreet.cli.commands.bench import record_file
from sparsestreet.cli.commands.options import run_command
from sparsestreet.cli.commands.scenes import open_scene, recorded_views
from sparsestreet.cli.config.log_from_options import reader_of
from sparsestreet.cli.config.targets import open_run_config
from sparsestreet.data.synthetic import StreetReader
from sparsestreet.data.synthetic.capture import Instant
from sparsestreet.data.synthetic.reader import camera_at
from sparsestreet.data.synthetic.render import developed
from sparsestreet.data.synthetic.world import build_world
from sparsestreet.evaluation.extra import shifted_views
from sparsestreet.types import View

REGIONS = {"0 to 20 m": (0.0, 20.0), "20 to 40 m": (20.0, 40.0), "beyond 40 m": (40.0, math.inf)}
"""Name -> depths along the optical axis, meters."""


@dataclass(frozen=True)
class Seen:
    """A view, what it shows, and the pixels of each region."""

    view: View
    image: UInt8[np.ndarray, "h w 3"]
    regions: Mapping[str, Bool[np.ndarray, "h w"]]


@dataclass(frozen=True)
class FarRecord:
    """One run from views moved by one offset to both sides."""

    street: int
    """Its seed."""
    run: str
    gaussians: int
    beside: float
    """Meters."""
    psnr: Mapping[str, float]
    """Region -> dB."""
    pixels: Mapping[str, float]
    """Region -> its share of the pixels."""


@dataclass(frozen=True)
class Difference:
    """What the second runs have more than the first ones, of the same streets."""

    beside: float
    region: str
    streets: int
    mean: float
    """dB."""
    within: float | None
    """Half of the paired 95 % t interval; None for one street."""


def traced(reader: StreetReader, views: Sequence[View]) -> list[Seen]:
    """Return what the street shows each view, without those inside of an actor."""
    street_from_world = reader.read().dataset_from_world
    world, (first, last) = build_world(reader.settings), reader.settings.recorded
    found = []
    for view in views:
        camera, instant = (
            camera_at(view.camera, street_from_world, 0.0),
            Instant.at(world, first + view.time * (last - first)),
        )
        if instant.inside_an_actor(camera):
            continue
        sight = instant.seen_by(camera, reader.settings.supersampling)
        solid, depth = ~sight.sky, sight.depth
        regions = {name: solid & (depth >= least) & (depth < most) for name, (least, most) in REGIONS.items()}
        found.append(Seen(view, developed(camera, sight).rgb, {"full": solid | sight.sky, "sky": sight.sky} | regions))
    return found


@torch.no_grad()
def measured(run: Path, seed: int, beside: float, views: Sequence[Seen]) -> FarRecord:
    """Return the errors of a run in these views. Raises FileNotFoundError without a scene."""
    stored = open_scene(run, "cpu")
    errors: dict[str, list[Float64[np.ndarray, " n"]]] = {name: [] for name in views[0].regions}
    for seen in views:
        image = stored.render(seen.view).rgb.clamp(0, 1).double().cpu().numpy()
        error = (image - seen.image / 255) ** 2
        for name, region in seen.regions.items():
            errors[name].append(error[region].ravel())
    pooled = {name: np.concatenate(some) for name, some in errors.items()}
    return FarRecord(
        street=seed,
        run=run.name,
        gaussians=sum(stored.scene.counts().values()),
        beside=beside,
        psnr={name: float(-10 * np.log10(some.mean())) for name, some in pooled.items() if some.size},
        pixels={name: some.size / pooled["full"].size for name, some in pooled.items()},
    )


def differences(before: Sequence[FarRecord], after: Sequence[FarRecord]) -> list[Difference]:
    """Return the differences of runs in pairs, of each offset and region that all have."""
    found = []
    for beside in sorted({one.beside for one in before}):
        pairs = [(a, b) for a, b in zip(before, after, strict=True) if a.beside == beside]
        for region in set.intersection(*(set(one.psnr) for pair in pairs for one in pair)):
            gains = np.array([b.psnr[region] - a.psnr[region] for a, b in pairs])
            count = len(gains)
            within = float(t.ppf(0.975, count - 1) * gains.std(ddof=1) / count**0.5) if count > 1 else None
            found.append(Difference(beside, region, count, float(gains.mean()), within))
    return found


USAGE = """\
python -m benchmarks.far_things before=RUN,... after=RUN,...     errors of embedded streets by distance

  before, after   runs on the same streets, in pairs
  beside          meters to both sides, 0 for the path (default: 0,3)
  streets         folder in which the streets lie or are traced (default: that of the runs)
  out             folder for far_things.jsonl (default: outputs/bench)
"""


@dataclass(frozen=True)
class FarRequest:
    """The script's options."""

    before: tuple[Path, ...]
    after: tuple[Path, ...]
    beside: tuple[float, ...] = (0.0, 3.0)
    streets: Path | None = None
    out: Path = Path("outputs/bench")


def street_of(run: Path, streets: Path | None) -> StreetReader:
    """Return the reader of a run's street. Raises ValueError for one of another log."""
    reader = reader_of(open_run_config(run))
    if not isinstance(reader, StreetReader):
        raise ValueError(f"{run} must be of an embedded street, whose depth is known: name another run")
    return reader if streets is None else replace(reader, root=None, parent=streets)


def write(request: FarRequest, file: RecordFile) -> None:
    """Measure each pair of runs, print and write."""
    records: tuple[list[FarRecord], list[FarRecord]] = [], []
    for pair in zip(request.before, request.after, strict=True):
        first, second = (street_of(run, request.streets) for run in pair)
        if first.settings != second.settings:
            raise ValueError(f"{pair[0]} and {pair[1]} are of different streets: name them in the same order")
        held_out = recorded_views(pair[0]).held_out
        for beside in request.beside:
            moved = [view for sign in (1, -1) for view in shifted_views(held_out, sign * beside, False)]
            views = traced(first, moved if beside else held_out)
            for some, run in zip(records, pair, strict=True):
                some.append(measured(run, first.settings.seed, beside, views))
                file.write("far", some[-1])
                print(some[-1], flush=True)
    for one in differences(*records):
        file.write("difference", one)
        print(one)


def main(words: list[str]) -> int:
    """Measure as the words say; 2 on wrong usage."""
    command = shlex.join(["python", "-m", "benchmarks.far_things", *words])

    def act(request: FarRequest) -> None:
        torch.set_num_threads(1)
        write(request, record_file(request.out, "far_things", command))

    return run_command("far_things", USAGE, words, FarRequest, act)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
