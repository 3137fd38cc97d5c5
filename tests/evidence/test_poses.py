"""Poses that are off, found from points whose truth is known; no image is looked at."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import Frames, as_frames
from sparsestreet.evidence import poses
from sparsestreet.evidence.poses import Bundle, PoseNoise, pose_noise
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import project
from sparsestreet.triangulation import StreetPoints, TriangulatedPoints
from sparsestreet.types import Camera, Frame, Track
from tests.scene.street import camera_at

FEATURE_NOISE = 0.05
LENS = torch.tensor([-0.2, 0.03, 0.0, 0.0, 0.0])


def true_camera(instant: int, lens: bool) -> Camera:
    """100 pixels of focal length, a meter ahead at each instant."""
    return replace(camera_at(float(instant), width=200, height=120), distortion=LENS if lens else None)


def off(camera: Camera, motion: torch.Tensor) -> Camera:
    """Its pose moved by a translation and a rotation vector in its own frame."""
    by = torch.eye(4, dtype=torch.float64)
    by[:3, :3] = quat.to_matrix(quat.from_rotation_vector(motion[3:]))
    by[:3, 3] = motion[:3]
    return replace(camera, camera_from_world=(by @ camera.camera_from_world.double()).float())


def measured(
    monkeypatch: pytest.MonkeyPatch,
    size: float,
    shared: Sequence[float] = (0.0,) * 6,
    *,
    lens: bool = False,
    jitter: float = FEATURE_NOISE,
) -> PoseNoise | None:
    """18 instants whose poses are off by turns of ``size`` pixels on each axis, and by what all of them share."""
    draw = torch.Generator().manual_seed(4)
    motions = torch.tensor(shared).double() + torch.cat(
        (torch.zeros(18, 3), size / 100 * torch.randn(18, 3, generator=draw)), 1
    )
    frames = []
    for instant, motion in enumerate(motions):
        image = torch.zeros(120, 200, 3, dtype=torch.uint8)
        frames.append(Frame(off(true_camera(instant, lens), motion), instant / 17, instant, 0, image=image))
    monkeypatch.setattr(poses, "street_points", lambda part, *_: seen_points(part, lens, jitter))
    return pose_noise(as_frames(frames), ())


def seen_points(frames: Frames, lens: bool, jitter: float = FEATURE_NOISE) -> StreetPoints:
    """What the true cameras see of 80 points, in pixels with the noise of features; one in ten is a wrong match."""
    draw = torch.Generator().manual_seed(frames.views[0].indices[0])
    first = frames.views[0].indices[0]
    places = torch.rand(80, 3, generator=draw) * torch.tensor([14.0, 14.0, 6.0]) + torch.tensor([first + 8, -7, -1.5])
    observed, views, pixels = [], [], []
    for number, view in enumerate(frames.views):
        seen, _, inside = project(true_camera(view.indices[0], lens), places)
        seen = seen + jitter * torch.randn(80, 2, generator=draw)
        wrong = torch.rand(80, generator=draw) < 0.1
        seen[wrong] += 3 * torch.randn(int(wrong.sum()), 2, generator=draw)
        observed += torch.nonzero(inside).flatten().tolist()
        views += [number] * int(inside.sum())
        pixels.append(seen[inside])
    count = len(places)
    points = TriangulatedPoints(
        places.numpy(),
        np.zeros((count, 3), np.float32),
        np.ones(count, np.float32),
        np.array(observed),
        np.array(views),
        torch.cat(pixels).numpy(),
    )
    return StreetPoints(points, {})


@pytest.mark.parametrize("lens", [False, True], ids=["pinhole", "lens"])
def test_the_value_is_what_errors_move_images_by(monkeypatch: pytest.MonkeyPatch, lens: bool):
    found = measured(monkeypatch, 1.0, lens=lens)
    assert found is not None
    # Turns about the optical axis move pixels by less than the others, which have 1 px. Twelve images, their median.
    assert 0.6 < found.value < 1.4
    assert 0 < found.error < 0.5
    assert found.images == len(found.by_image) == len(found.indices) == 12
    assert found.points == 3 * 80


def test_right_poses_move_nothing(monkeypatch: pytest.MonkeyPatch):
    found = measured(monkeypatch, 0.0)
    assert found is not None
    assert found.value < FEATURE_NOISE


def test_the_noise_of_features_is_no_noise_of_poses(monkeypatch: pytest.MonkeyPatch):
    found = measured(monkeypatch, 0.0, jitter=0.4)
    assert found is not None
    # Of twelve images half have less than their floor: what is left of the median is small beside it.
    assert found.value < 0.5 * float(np.median(found.by_image))


def test_what_all_images_share_is_no_noise(monkeypatch: pytest.MonkeyPatch):
    found = measured(monkeypatch, 0.0, (0.0, 0.0, 0.0, 0.03, 0.0, 0.0))
    assert found is not None
    assert found.value < 2 * FEATURE_NOISE


def test_what_is_constant_is_of_the_camera_that_has_most():
    """Median corrections of 0.1 and 3, one of them by a wrong image; slopes are those of pixels a number."""
    corrections = np.zeros((6, 6))
    corrections[:3, 0], corrections[3:, 0] = 0.1, (3.0, 3.0, 50.0)
    nothing, slopes = np.zeros((6, 6, 6, 6)), np.tile(np.eye(6), (6, 1, 1))
    bundle = Bundle(corrections, slopes, nothing, np.full(6, 30))
    cameras = np.array([0, 0, 0, 1, 1, 1])
    none = np.zeros(0)
    stretch = poses._Stretch(np.zeros((0, 2), np.int64), none, none, bundle, cameras, 30)
    assert poses._constant([stretch]) == pytest.approx(3.0)


def test_a_car_that_stands_says_nothing(monkeypatch: pytest.MonkeyPatch):
    image = torch.zeros(120, 200, 3, dtype=torch.uint8)
    still = [Frame(true_camera(0, False), instant / 9, instant, 0, image=image) for instant in range(10)]
    empty = np.zeros((0, 3), np.float32)
    none = np.zeros(0, np.int64)
    nothing = TriangulatedPoints(empty, empty, np.zeros(0, np.float32), none, none, np.zeros((0, 2), np.float32))

    def looked_at(frames: Frames, moving: Sequence[Track], settings: object) -> StreetPoints:
        assert len(frames) == 1  # of instants at one place, the first
        return StreetPoints(nothing, {})

    monkeypatch.setattr(poses, "street_points", looked_at)
    assert pose_noise(as_frames(still), ()) is None
