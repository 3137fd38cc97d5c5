"""Sweeps in the colors of some images of their instant alone, where others are held out."""

from dataclasses import replace

from sparsestreet.data.lazy import Sweeps
from sparsestreet.data.lidar import color_points, seen_points
from sparsestreet.data.log import DrivingLog, Split
from sparsestreet.geometry.boxes import CarriedPoints, without_frames
from sparsestreet.types import Sweep


def recolored(log: DrivingLog, parts: Split) -> Sweeps:
    """The log's sweeps, colored by training views and by no other image, and carried to these by no held-out box; an
    instant without such a view keeps its own colors."""
    frames, tracks = parts.train, without_frames(log.tracks, parts.held_out_indices)
    places: dict[int, list[int]] = {}
    for place, view in enumerate(frames.views):
        places.setdefault(view.indices[0], []).append(place)

    def carried(sweep: Sweep) -> CarriedPoints:
        return CarriedPoints(sweep.points, sweep.time, sweep.index, tracks)

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
