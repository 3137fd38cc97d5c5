"""What a sweep of each lidar takes beside a picture of a trained street: ``python -m benchmarks.sweeps``.

Sweep and picture of an instant are drawn one after the other, and the ratio is theirs. Milliseconds are of the
processor: a machine on which others compute changes them less than those of a clock.
"""

import shlex
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle, islice
from operator import truediv
from pathlib import Path
from typing import TypeVar

import numpy as np

from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.timing import TimeSpread, spread
from sparsestreet.cli.commands.bench import record_file
from sparsestreet.cli.commands.options import run_command
from sparsestreet.data.lidar_models import NAMES, LidarModel, lidar_model
from sparsestreet.evaluation.speed import frame_image
from sparsestreet.export.sweeps import Mounted, mounted
from sparsestreet.geometry.cameras import inverse
from sparsestreet.scene.storage import StoredScene, load_scene, views_of
from sparsestreet.scene.sweeps import render_sweep
from sparsestreet.scene.views import seconds_of
from sparsestreet.types import View

CAMERA_FROM_VEHICLE = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""The lidar is in the front camera, whose z is ahead and whose y is down."""


Drawn = TypeVar("Drawn")


@dataclass(frozen=True)
class SweepRecord:
    """Sweeps of one lidar and pictures of the front camera, in turn at the same instants."""

    scene: str
    gaussians: int
    lidar: str
    rays: int
    returns: float
    """Median of a sweep."""
    picture: str
    sweep_ms: TimeSpread
    picture_ms: TimeSpread
    ratio: float
    """Median of the sweep's time over that of the picture just before it."""
    ratio_quartiles: tuple[float, float]


def run_sweeps(scenes: Sequence[Path], lidars: Sequence[str], repeats: int, file: RecordFile) -> None:
    """Time every lidar in every scene; each record is on disk at once. Raises FileNotFoundError without a scene."""
    for scene in scenes:
        stored, recorded = load_scene(scene), views_of(scene)
        least = min(view.indices[1] for view in recorded.all)
        front = sorted((view for view in recorded.all if view.camera_index == least), key=lambda view: view.time)
        for lidar in lidars:
            way = along_camera(lidar_model(lidar), front, seconds_of(recorded, 10.0))
            record = timed(scene.name, stored, way, front, repeats)
            file.write("sweeps", record)
            low, high = record.ratio_quartiles
            print(
                f"{record.scene}, {lidar}: {record.sweep_ms.median:.0f} ms, {record.ratio:.1f} pictures "
                f"({low:.1f} to {high:.1f}) of {record.picture}; {record.returns:,.0f} of {record.rays:,} rays return"
            )


def timed(name: str, stored: StoredScene, way: Mounted, front: Sequence[View], repeats: int) -> SweepRecord:
    """Draw pictures and sweeps in turn, over the whole log; the first pair is not counted."""
    sweeps, pictures, returns = [], [], []
    for view in islice(cycle(front[:: max(1, len(front) // (repeats + 1))]), repeats + 1):
        pictures.append(seconds(partial(frame_image, stored.scene, view, stored.options))[0])
        draw = partial(render_sweep, stored.scene, way.model, way.at(view.time), view.time, stored.options)
        taken, found = seconds(partial(draw, duration=way.duration))
        sweeps.append(taken)
        returns.append(len(found))
    low, middle, high = statistics.quantiles(map(truediv, sweeps[1:], pictures[1:]), n=4, method="inclusive")
    return SweepRecord(
        scene=name,
        gaussians=sum(stored.scene.counts().values()),
        lidar=way.model.name,
        rays=len(way.model.directions()),
        returns=statistics.median(returns[1:]),
        picture=f"{front[0].camera.width}x{front[0].camera.height}",
        sweep_ms=spread(sweeps[1:]),
        picture_ms=spread(pictures[1:]),
        ratio=middle,
        ratio_quartiles=(low, high),
    )


def along_camera(model: LidarModel, front: Sequence[View], duration: float) -> Mounted:
    """Put a lidar where a camera is on its way, level as that is. Raises ValueError for a log of one instant."""
    poses = [inverse(view.camera.camera_from_world.double()).numpy() @ CAMERA_FROM_VEHICLE for view in front]
    return mounted(model, [view.time for view in front], poses, (0.0, 0.0, 0.0), duration)


def seconds(draw: Callable[[], Drawn]) -> tuple[float, Drawn]:
    """Return seconds of the processor, of all threads, and what was drawn."""
    started = time.process_time()
    drawn = draw()
    return time.process_time() - started, drawn


USAGE = f"""\
python -m benchmarks.sweeps scenes=A,B [key=value ...]     sweeps of lidars beside pictures, on the CPU

  scenes    runs' folders or .street files
  lidars    names or .json files (default: {",".join(NAMES)})
  repeats   pairs of a sweep and a picture (default: 9)
  out       folder for sweeps.jsonl (default: outputs/bench)
"""


@dataclass(frozen=True)
class SweepsRequest:
    """The script's options. Raises ValueError where they are wrong."""

    scenes: tuple[Path, ...]
    lidars: tuple[str, ...] = tuple(NAMES)
    repeats: int = 9
    out: Path = Path("outputs/bench")

    def __post_init__(self) -> None:
        if not self.scenes or not self.lidars or self.repeats < 2:
            raise ValueError(f"sweeps need a scene, a lidar and 2 repeats, got {self.scenes}, {self.repeats}")


def main(words: list[str]) -> int:
    """Time as the words say; statuses as in ``run_command``."""
    command = shlex.join(["python", "-m", "benchmarks.sweeps", *words])

    def act(request: SweepsRequest) -> None:
        run_sweeps(request.scenes, request.lidars, request.repeats, record_file(request.out, "sweeps", command))

    return run_command("sweeps", USAGE, words, SweepsRequest, act)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
