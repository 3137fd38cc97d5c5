"""A log that is written in the layout of a data set and read again, and what must be equal then."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sparsestreet.data.lazy import as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic import StreetReader, StreetSettings, make_street
from sparsestreet.data.synthetic.sensor import WAYMO_TOP
from sparsestreet.data.writer import LogWriter
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Frame, Track, View
from tests.conftest import unchecked
from tests.shared import made_once

STREET = StreetSettings(
    seed=3, num_frames=3, width=48, height=32, num_cameras=3, supersampling=1, ego_speed=15.0, num_parked_cars=2,
    num_moving_cars=3, num_pedestrians=1, num_cyclists=1, lidar=replace(WAYMO_TOP, beams=16, azimuth_steps=120),
    delays=(0.02, 0.0, -0.03),
)  # fmt: skip
FLOAT32 = 2e-5
"""Meters: logs hold poses and points in float32, whose steps are 4e-6 at 40 m, and files round them once more."""


def street(factory: pytest.TempPathFactory) -> DrivingLog:
    """Three frames of three cameras with instants of their own, the first 30 ms before the log's clock starts."""

    def make(folder: Path) -> None:
        with unchecked():
            make_street(STREET, folder)

    return StreetReader(STREET, made_once(factory, "street_to_write", make)).read()


def written(writer: LogWriter, log: DrivingLog, root: Path) -> Path:
    for file in writer.files(log):
        path = root / file.path
        path.parent.mkdir(parents=True, exist_ok=True)
        assert not path.exists(), f"{file.path} is written twice"
        path.write_bytes(b"".join(file.content()))
    return root


def with_cameras(log: DrivingLog, **values: object) -> DrivingLog:
    """The log, in memory, with other values of all its cameras."""
    frames = [replace(frame, camera=replace(frame.camera, **values)) for frame in log.frames]
    return replace(log, frames=as_frames(frames))


def matching(log: DrivingLog, back: DrivingLog, names: Mapping[int, str]) -> list[tuple[Frame, Frame]]:
    """Frames of both, paired by frame and by the camera's name, which ``names`` says by the index in ``log``."""
    found = {(frame.indices[0], back.camera_names[frame.indices[1]]): frame for frame in back.frames}
    assert len(found) == len(log.frames)
    return [(frame, found[frame.indices[0], names[frame.indices[1]]]) for frame in log.frames]


def check_cameras(log: DrivingLog, back: DrivingLog, pairs: list[tuple[Frame, Frame]], atol: float = FLOAT32) -> None:
    for one, other in pairs:
        torch.testing.assert_close(other.camera.intrinsics, one.camera.intrinsics, rtol=1e-6, atol=0)  # float32
        assert (other.camera.width, other.camera.height) == (one.camera.width, one.camera.height)
        torch.testing.assert_close(camera_pose(back, other), camera_pose(log, one), rtol=0, atol=atol)


def camera_pose(log: DrivingLog, view: View) -> torch.Tensor:
    """world_from_camera in the data set's own world."""
    return log.dataset_from_world @ inverse(view.camera.camera_from_world.double())


def check_stamps(pairs: list[tuple[Frame, Frame]], later: int = 0) -> None:
    """``later``: nanoseconds that were added."""
    assert [other.stamp for _, other in pairs] == [(one.stamp or 0) + later for one, _ in pairs]


def check_points(log: DrivingLog, back: DrivingLog, later: int | None = 0, atol: float = FLOAT32) -> None:
    """``later`` as above; None: the stamps are others."""
    assert back.sweeps.indices == log.sweeps.indices
    for one, other in zip(log.sweeps.gray(), back.sweeps.gray(), strict=True):
        assert later is None or other.stamp == (one.stamp or 0) + later
        points = [transform_points(source.dataset_from_world, sweep.points.double())
                  for source, sweep in ((log, one), (back, other))]  # fmt: skip
        torch.testing.assert_close(points[1], points[0], rtol=0, atol=atol)


def check_boxes(
    log: DrivingLog, back: DrivingLog, names: Mapping[str, str], lost: Collection[str] = (), atol: float = FLOAT32
) -> None:
    """``names``: by which ``back`` knows objects, where it is not their own; ``lost``: those that are not there."""
    found = {track.name: track for track in back.tracks}
    assert set(found) == {names.get(one.name, one.name) for one in log.tracks if one.name not in lost}
    for one in log.tracks:
        if one.name not in lost:
            other = found[names.get(one.name, one.name)]
            assert torch.equal(other.frames, one.frames)
            assert torch.allclose(other.size, one.size, rtol=1e-6)  # float32
            torch.testing.assert_close(places(back, other), places(log, one), rtol=0, atol=atol)
            if one.times is not None and other.times is not None:
                # Both clocks run from the first stamp of anything to the last: 2e-9 of 0.3 s is below a nanosecond.
                torch.testing.assert_close(other.times, one.times, rtol=0, atol=2e-9)


def places(log: DrivingLog, track: Track) -> torch.Tensor:
    """Poses of the boxes in the data set's own world."""
    return log.dataset_from_world @ track.world_from_object
