"""Sweeps in the colors of some images of their instant alone, where others are held out."""

from dataclasses import replace

from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.lidar import color_points, seen_points
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.boxes import CarriedPoints
from sparsestreet.types import Sweep


def recolored(log: DrivingLog, frames: Frames) -> Sweeps:
    """The log's sweeps, colored by ``frames`` and by no other image; an instant without one keeps its own colors."""
    places: dict[int, list[int]] = {}
    for place, view in enumerate(frames.views):
        places.setdefault(view.indices[0], []).append(place)

    def carried(sweep: Sweep) -> CarriedPoints:
        return CarriedPoints(sweep.points, sweep.time, sweep.index, log.tracks)

    def load(index: int) -> Sweep:
        if index not in places:
            return log.sweeps.load(index)
        sweep, seen = log.sweeps.load_gray(index), list(frames.at(places[index]))
        at = [carried(sweep).at(frame.time) for frame in seen]
        colors, colored = color_points(sweep.points, seen, at)
        return replace(sweep, colors=colors, colored=colored)

    def load_gray(index: int) -> Sweep:
        sweep, views = log.sweeps.load_gray(index), frames.at(places.get(index, [])).views
        if not views:
            return sweep
        at = [carried(sweep).at(view.time) for view in views]
        return replace(sweep, colored=seen_points(sweep.points, [view.camera for view in views], at))

    return Sweeps(log.sweeps.indices, load, load_gray)
