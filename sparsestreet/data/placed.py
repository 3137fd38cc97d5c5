"""Where everything of a log is, and when, in its data set's own world and clock: what files of a data set state."""

from collections.abc import Iterator
from dataclasses import dataclass

from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.log_times import LogTimes
from sparsestreet.data.vehicle import dataset_from_camera
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.boxes import CarriedPoints, box_at, inside_box
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Sweep, Track, View


@dataclass(frozen=True)
class PlacedLog:
    """Poses, points, boxes and stamps of a log, as its data set has them."""

    log: DrivingLog
    times: LogTimes

    def world_from_camera(self, view: View) -> Float64[Tensor, "4 4"]:
        """OpenCV's axes; a rotation to float64's precision, although the view has float32."""
        pose = dataset_from_camera(self.log, view)
        pose[:3, :3] = quat.to_matrix(quat.from_matrix(pose[:3, :3]))
        return pose

    def view_stamp(self, view: View) -> int:
        return self.times.of_view(view)

    def sweep_stamp(self, sweep: Sweep) -> int:
        return self.times.stamp(sweep.time) if sweep.stamp is None else sweep.stamp + self.times.shift

    def box_stamps(self, track: Track) -> dict[int, int]:
        """Frame -> the stamp of the object's box."""
        times = self.times.timed(track, self.log.num_frames).times
        assert times is not None  # as timed says
        return {
            frame: self.times.stamp(time) for frame, time in zip(track.frames.tolist(), times.tolist(), strict=True)
        }

    def points(self, sweep: Sweep, stamp: int | None = None) -> Float64[Tensor, "n 3"]:
        """As measured; or those in boxes where the boxes are at a stamp, for layouts in which a frame has but one."""
        points = sweep.points
        if stamp is not None and stamp != self.sweep_stamp(sweep):
            carried = CarriedPoints(points, sweep.time, sweep.index, self.log.tracks)
            points = carried.at(self.times.time(stamp))
        return transform_points(self.log.dataset_from_world, points.double())

    def box(self, track: Track, frame: int, stamp: int) -> Float64[Tensor, "4 4"]:
        """world_from_object at a stamp that belongs to one of the object's frames."""
        pose = box_at(track, frame, self.times.time(stamp))
        assert pose is not None  # the frame is one of the track's
        return self.log.dataset_from_world @ pose

    def returns_in(self, track: Track, sweep: Sweep) -> int:
        """How many returns lie in the object's box."""
        pose = box_at(track, sweep.index, sweep.time)
        if pose is None:
            return 0
        return int(inside_box(transform_points(inverse(pose).float(), sweep.points), track.size).sum())

    def time_losses(self, unit: int = 1) -> Iterator[str]:
        """What becomes of stamps in a layout that counts whole ``unit`` nanoseconds, a sentence each."""
        yield from self.times.losses()
        stamps = [self.view_stamp(view) for view in self.log.views]
        if rounded := sum(stamp % unit > 0 for stamp in stamps):
            yield f"the stamps of {rounded} of {len(stamps)} images are rounded to whole {unit} ns"


def quaternion(pose: Float64[Tensor, "4 4"]) -> list[float]:
    """w, x, y, z of a transform's rotation."""
    return quat.from_matrix(pose[:3, :3]).tolist()
