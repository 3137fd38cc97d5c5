"""A request for a sweep as a turn of a lidar, and its returns as a message. Nothing here knows of a network."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.lidar_models import LidarModel, lidar_model
from sparsestreet.scene.edits import Edits
from sparsestreet.scene.edits.paths import between
from sparsestreet.scene.sweeps import Returns, render_sweep
from sparsestreet.serving import wire
from sparsestreet.serving.cameras import NotServedError, matrix
from sparsestreet.serving.renderer import ServedScene, with_objects
from sparsestreet.serving.rig import Pose, Rig

_MODELS = {"AT128": "at128"}
"""Name of the interface -> of the tables."""
MAX_TURN = 1.0
"""Seconds from the first to the last column."""
_STANDS = 1e9
"""Seconds of a log whose time does not go on during a turn."""


@dataclass(frozen=True)
class Turn:
    """One sweep: a lidar, and its way while it turns."""

    model: LidarModel
    start: Pose
    """world_from_lidar at the first column."""
    end: Pose
    """The same at the end, in whose frame the points are."""
    seconds: float
    """From start to end."""
    time: float
    """Normalized, of the end."""
    duration: float
    """Seconds from normalized time 0 to 1, as the clock of the log goes during the turn."""

    def pose(self, seconds: float) -> Float64[Tensor, "4 4"]:
        """Return world_from_lidar by the seconds since the end."""
        share = 1 + seconds / self.seconds if self.seconds > 0 else 1.0
        return torch.from_numpy(between(self.start, self.end, share))


def turn_of(request: Any, rig: Rig) -> Turn:
    """Return the turn of a request. Raises ValueError, NotServedError for a lidar whose angles are not known."""
    model = _model_of(request.lidar_config)
    start_us, end_us = request.frame_start_us, request.frame_end_us
    if not 0 <= end_us - start_us <= 1e6 * MAX_TURN:
        raise ValueError(f"a turn ends at most {MAX_TURN:g} s after it starts, got {start_us} to {end_us} us")
    start = matrix(request.sensor_pose.start_pose, "sensor_pose.start_pose")
    end = matrix(request.sensor_pose.end_pose, "sensor_pose.end_pose")
    times, seconds = (rig.clock.time(start_us), rig.clock.time(end_us)), (end_us - start_us) / 1e6
    passes = times[1] > times[0]
    return Turn(model, start, end, seconds, times[1], seconds / (times[1] - times[0]) if passes else _STANDS)


def _model_of(config: Any) -> LidarModel:
    name = wire.word("LidarDeviceType", config.lidar_type)
    if name not in _MODELS:
        why = "has no published table of angles by that name" if name == "PANDAR128" else "is no lidar of the interface"
        raise NotServedError(f"lidar_type {name} {why}, and none is guessed: send {', '.join(_MODELS)}")
    return lidar_model(_MODELS[name])


def sweep(served: ServedScene, turn: Turn, edits: Edits) -> Returns:
    """Return what comes back; on the device of the scene, which takes one at a time."""
    stored, span = served.stored, (-turn.seconds, 0.0)
    scene = with_objects(stored.scene, edits)
    return render_sweep(
        scene, turn.model, turn.pose, turn.time, stored.options, duration=turn.duration, span=span
    )  # fmt: skip


def lidar_message(found: Returns) -> Any:
    """Return a LidarRenderReturn: float32, as lists and as the bytes of arrays, for clients of either."""
    points, intensities = (one.numpy().astype("<f4") for one in (found.points, found.intensities))
    return wire.kind("LidarRenderReturn")(
        point_xyzs=points.ravel(),
        point_intensities=intensities,
        num_points=len(found),
        point_xyzs_buffer=np.ascontiguousarray(points).tobytes(),
        point_intensities_buffer=intensities.tobytes(),
    )
