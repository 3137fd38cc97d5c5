"""What both versions of Waymo's Open Dataset have in common when a log is written in their layout."""

from abc import ABC
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from sparsestreet.data.directions import name_losses
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.losses import object_losses, point_losses
from sparsestreet.data.waymo.images import middle
from sparsestreet.data.waymo.log_boxes import LogBoxes, class_name
from sparsestreet.data.waymo.log_segment import READOUT, Grid, LogSegment
from sparsestreet.data.writer import LogWriter


@dataclass(frozen=True, kw_only=True)
class WaymoWriter(LogWriter, ABC):
    """A log as a segment. Cameras get Waymo's names by where they look; all returns are the lidar TOP's."""

    jpeg_quality: int | None = 95
    """Of images; None: PNG, which our reader and others that look at the bytes take."""
    camera: Sequence[float | int] = (1.6, 0.0, 1.65)
    """Where the first camera is in the vehicle, meters ahead, left and up; a log does not tell. As the street's."""
    lidar: Sequence[float | int] = (0.9, 0.0, 1.9)
    """Where the lidar is in the vehicle. Rays of the right place keep beams apart. As the street's."""
    rows: int = 256
    """At most, of range images; the beams of a sensor with fewer are found."""
    columns: int = 4096
    """At most; the steps of a sensor that turns evenly are found."""

    def segment(self, log: DrivingLog) -> LogSegment:
        places = tuple(map(float, self.camera)), tuple(map(float, self.lidar))
        return LogSegment(log, Grid(*places, self.rows, self.columns))

    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        segment = self.segment(log)
        pixels = () if self.jpeg_quality is None else (f"images become JPEG of quality {self.jpeg_quality}",)
        return (
            *segment.times.losses(),
            *_of_stamps(segment),
            *name_losses(segment.placed, segment.names),
            *pixels,
            *_of_masks(segment),
            *object_losses(log, class_name),
            *LogBoxes(segment).losses(),
            *_of_returns(segment),
            *point_losses(log),
        )


def _of_stamps(segment: LogSegment) -> Iterator[str]:
    """Frames are written in microseconds, images in doubles of seconds."""
    spins = zip(segment.stamps, segment.instants, strict=True)
    late = max(abs(1000 * begin + 50_000_000 - instant) for begin, instant in spins)
    names, times = segment.names, segment.times
    shots = [(segment.motion(names[view.indices[1]], view), times.of_view(view)) for view in segment.log.views]
    off = max(abs(middle(motion) - stamp) for motion, stamp in shots)
    if late or off:
        yield f"stamps are rounded: those of sweeps by up to {late} ns, those of images by up to {off} ns"
    if any(view.camera.shutter is not None for view in segment.log.views):
        yield f"the log tells how far cameras move in a readout, not how long it takes: {READOUT / 1e6:g} ms is said"


def _of_masks(segment: LogSegment) -> Iterator[str]:
    """As the first image of each camera has them: no other is decoded."""
    first = {view.indices[1]: view for view in reversed(segment.log.views)}
    frames = [segment.frame(first[index]) for index in sorted(first)]
    kinds = ("sky", "human", "vehicle")
    absent = [kind for kind in kinds if all(getattr(frame, kind) is None for frame in frames)]
    if absent and len(absent) < len(kinds):
        yield f"the log has no masks of {', '.join(absent)}: they come back, and are empty"
    given = [[mask for kind in kinds if (mask := getattr(frame, kind)) is not None] for frame in frames]
    if double := sum(int((torch.stack(masks).sum(0) > 1).sum()) for masks in given if masks):
        yield f"a pixel has one class: {double} pixels of the first images are in two masks and keep one"
    if any(frame.ego is not None for frame in frames):
        yield "masks of the recording car are written as Waymo's class 1, which our reader passes over"


def _of_returns(segment: LogSegment) -> Iterator[str]:
    placed = [one for frame in segment.log.sweeps.indices if (one := segment.places(frame)) is not None]
    lidar = segment.lidar
    if lidar is None:
        return
    moved, lost = np.concatenate([one.moved for one in placed]), sum(one.lost for one in placed)
    height, width = placed[0].ranges.shape[1:]
    yield (
        f"{lost} of {lost + len(moved)} returns find no place in range images of {height} x {width} rays, two a ray; "
        f"the others move by {np.sqrt(np.mean(moved**2)) * 1e3:.2g} mm (RMS), by {moved.max() * 1e3:.2g} mm at most"
    )
    places = np.stack([segment.world_from_vehicle(frame)[:3, 3].numpy() for frame in segment.log.sweeps.indices])
    rounded = np.abs(places - places.astype(np.float32)).max()
    if rounded > 1e-4:
        yield f"poses of pixels are float32: {rounded * 1e3:.2g} mm are lost at this place of the data set's world"
