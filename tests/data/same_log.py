"""Whether a log that was written and read again is the one that it was."""

import torch

from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Frame, Track, View


def check_same_views(found: DrivingLog, wanted: DrivingLog) -> None:
    """Poses in the data set's world, lenses, sizes, times and stamps."""
    assert [view.indices for view in found.views] == [view.indices for view in wanted.views]
    # A log's poses are float32, and a translation is -R^T t of the position: a few roundings of what lies 100 m away.
    for one, other in zip(found.views, wanted.views, strict=True):
        torch.testing.assert_close(in_data_set(found, one), in_data_set(wanted, other), atol=2e-5, rtol=0)
        assert (one.camera.width, one.camera.height) == (other.camera.width, other.camera.height)
        torch.testing.assert_close(one.camera.intrinsics, other.camera.intrinsics, atol=0, rtol=0)
        torch.testing.assert_close(one.camera.distortion, other.camera.distortion, atol=0, rtol=0)
        assert (one.stamp, one.seconds) == (other.stamp, other.seconds)
        assert abs(one.time - other.time) < 1e-12


def check_same_masks(found: Frame, wanted: Frame) -> None:
    for kind in ("sky", "human", "vehicle", "ego"):
        one, other = getattr(found, kind), getattr(wanted, kind)
        assert (one is None) == (other is None), kind
        assert one is None or torch.equal(one, other), kind


def check_same_sweeps(found: DrivingLog, wanted: DrivingLog) -> None:
    assert (found.sweeps.indices, found.sweeps.stamps) == (wanted.sweeps.indices, wanted.sweeps.stamps)
    for one, other in zip(found.sweeps.gray(), wanted.sweeps.gray(), strict=True):
        assert (one.stamp, one.seconds) == (other.stamp, other.seconds)
        points = transform_points(found.dataset_from_world, one.points.double())
        # float32 around the camera: 4 micrometers at 64 m, and again in the log's world.
        torch.testing.assert_close(
            points, transform_points(wanted.dataset_from_world, other.points.double()), atol=5e-5, rtol=0
        )


def check_same_track(found: DrivingLog, one: Track, wanted: DrivingLog, other: Track) -> None:
    """Boxes in the data set's world, their times, and the body."""
    assert one.frames.tolist() == other.frames.tolist()
    poses, expected = (log.dataset_from_world @ t.world_from_object for log, t in ((found, one), (wanted, other)))
    torch.testing.assert_close(poses, expected, atol=1e-9, rtol=1e-12)  # float64, as text with all digits
    torch.testing.assert_close(one.size, other.size, atol=0, rtol=1e-6)
    assert (one.times is None) == (other.times is None)
    if one.times is not None and other.times is not None:
        torch.testing.assert_close(one.times, other.times, atol=1e-12, rtol=0)
    assert (one.body is None) == (other.body is None)
    if one.body is not None and other.body is not None:
        assert torch.equal(one.body.valid, other.body.valid)
        assert torch.equal(one.body.shape, other.body.shape)
        dots = (one.body.rotations * other.body.rotations).sum(-1)[one.body.valid].abs()
        assert (1 - dots).max() < 1e-6  # float32 matrices in the file: 1e-3 rad at most


def in_data_set(log: DrivingLog, view: View) -> torch.Tensor:
    return log.dataset_from_world @ inverse(view.camera.camera_from_world.double())
