"""What is to be seen: the street at a time of its log, with its edits, from anywhere."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import Rotation, Slerp

from sparsestreet.geometry.cameras import inverse
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import Camera, View
from sparsestreet.viewing.edit_state import EditState


@dataclass(frozen=True)
class Eye:
    """From where a window looks, and its size."""

    world_from_camera: Float64[np.ndarray, "4 4"]
    """OpenCV's axes, meters."""
    fov: float
    """Vertical, radians."""
    width: int
    height: int
    """Pixels of the window."""

    def same(self, other: "Eye") -> bool:
        """Whether two show the same; poses differ by rounding alone."""
        near = np.allclose(self.world_from_camera, other.world_from_camera, rtol=0, atol=1e-6)
        sizes = (self.width, self.height) == (other.width, other.height)
        return near and sizes and abs(self.fov - other.fov) < 1e-6

    def camera(self, width: int, height: int) -> Camera:
        """A pinhole that shows the window's part of the world in an image of this size."""
        focal = height / 2 / math.tan(self.fov / 2)
        intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        return Camera(inverse(torch.from_numpy(self.world_from_camera)).float(), intrinsics, width, height)


class RecordedCamera:
    """One of the log's cameras: where it was at any time, straight and by slerp between its views."""

    def __init__(self, views: Sequence[View]) -> None:
        ordered = sorted(views, key=lambda view: view.time)
        self.times = np.array([view.time for view in ordered])
        poses = np.stack([inverse(view.camera.camera_from_world.double()).numpy() for view in ordered])
        self._positions, self._turns = poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3])
        camera = ordered[0].camera
        self.fov = 2 * math.atan(camera.height / 2 / float(camera.intrinsics[1, 1]))

    def at(self, time: float) -> Float64[np.ndarray, "4 4"]:
        """world_from_camera at a normalized time; before the first and after the last view as there."""
        time = float(np.clip(time, self.times[0], self.times[-1]))
        pose = np.eye(4)
        pose[:3, 3] = [np.interp(time, self.times, self._positions[:, axis]) for axis in range(3)]
        turns = self._turns if len(self.times) > 1 else None
        pose[:3, :3] = (self._turns[0] if turns is None else Slerp(self.times, turns)(time)).as_matrix()
        return pose


class Stage:
    """A scene, its edits, and a clock that runs while it plays; ``version`` counts changes of what is to be seen."""

    def __init__(self, stored: StoredScene, views: Sequence[View], edits: EditState) -> None:
        self.stored, self.edits = stored, edits
        self.start, self.end = min(view.time for view in views), max(view.time for view in views)
        indices = sorted({view.indices[1] for view in views})
        self.cameras = {
            index: RecordedCamera([view for view in views if view.indices[1] == index]) for index in indices
        }
        self.seconds, self.playing, self.version = 0.0, False, 0
        self._ticked: float | None = None

    @property
    def duration(self) -> float:
        """Seconds from the first to the last view."""
        return (self.end - self.start) * self.edits.seconds

    @property
    def time(self) -> float:
        """Normalized time that is shown."""
        return self.start + self.seconds / self.edits.seconds

    def seek(self, seconds: float) -> None:
        """Show another time, seconds since the first view."""
        seconds = min(max(seconds, 0.0), self.duration)
        if seconds != self.seconds:
            self.seconds, self.version = seconds, self.version + 1

    def play(self, playing: bool) -> None:
        self.playing, self._ticked = playing, None

    def tick(self, now: float) -> None:
        """It is ``now``, seconds of any clock: what plays goes on at the log's speed, from the end to the start."""
        if self.playing and self._ticked is not None:
            after = self.seconds + now - self._ticked
            self.seek(after if after <= self.duration else 0.0)
        self._ticked = now

    def changed(self) -> None:
        """The edits have changed."""
        self.version += 1

    def picture(self, eye: Eye, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
        """The scene now, in an image of this size."""
        view = View(eye.camera(width, height), self.time)
        rgb = replace(self.stored, scene=self.edits.scene).render(view).rgb
        return (rgb.clamp(0, 1) * 255).round().byte().cpu().numpy()
