"""Points that are kept on disk."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import as_frames
from sparsestreet.triangulation import (
    ImagePointSettings,
    StreetPoints,
    TriangulatedPoints,
    cached_street_points,
    street,
)
from sparsestreet.types import Camera, Frame, Track

FRAMES = tuple(
    Frame(
        Camera(torch.eye(4), torch.eye(3), 6, 4, torch.zeros(5)), 0.0, index, 0,
        image=torch.full((4, 6, 3), index, dtype=torch.uint8), sky=torch.zeros(4, 6, dtype=torch.bool),
    )
    for index in range(2)
)  # fmt: skip
TURN = torch.tensor([[0.0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
TRACK = Track("car", "Vehicle", torch.tensor([0, 1]), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), torch.ones(3))


def _table(count):
    rng = np.random.default_rng(count)
    observed = np.repeat(np.arange(count), 3)
    return TriangulatedPoints(
        rng.random((count, 3), np.float32), rng.random((count, 3), np.float32), rng.random(count, np.float32),
        observed, np.tile(np.arange(3), count), rng.random((3 * count, 2), np.float32),
    )  # fmt: skip


POINTS = StreetPoints(_table(5), {"car": _table(2), "": _table(0)})


@pytest.fixture
def made(monkeypatch):
    """Each making of points adds one; the points are always the same."""
    makings = []
    monkeypatch.setattr(street, "street_points", lambda *inputs: makings.append(inputs) or POINTS)
    return makings


def _get(folder, frames=FRAMES, tracks=(TRACK,), **changes):
    return cached_street_points(as_frames(frames), tracks, ImagePointSettings(cache=folder, **changes))


def test_points_are_read_back_as_they_were(tmp_path, made):
    first, second = _get(tmp_path / "new"), _get(str(tmp_path / "new"))
    assert len(made) == 1
    assert first is POINTS
    assert list(second.in_boxes) == ["car", ""]
    for one, other in zip(
        (POINTS.static, *POINTS.in_boxes.values()), (second.static, *second.in_boxes.values()), strict=True
    ):
        for name in ("positions", "colors", "pixel_sizes", "observed", "views", "pixels"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
            assert getattr(one, name).dtype == getattr(other, name).dtype


def test_a_street_without_boxes_is_read_back(tmp_path, monkeypatch):
    monkeypatch.setattr(street, "street_points", lambda *inputs: StreetPoints(_table(1), {}))
    assert dict(_get(tmp_path).in_boxes) == dict(_get(tmp_path).in_boxes) == {}


def test_without_a_folder_points_are_made_anew(made):
    assert _get(None) is _get(None) is POINTS
    assert len(made) == 2


def _other_camera(**changes):
    return replace(FRAMES[0], camera=replace(FRAMES[0].camera, **changes))


OTHERS = {
    "image": replace(FRAMES[0], image=FRAMES[0].image + 1),
    "sky": replace(FRAMES[0], sky=~FRAMES[0].sky),
    "no sky": replace(FRAMES[0], sky=None),
    "hood": replace(FRAMES[0], ego=torch.ones(4, 6, dtype=torch.bool)),
    "pose": _other_camera(camera_from_world=2 * torch.eye(4)),
    "intrinsics": _other_camera(intrinsics=2 * torch.eye(3)),
    "distortion": _other_camera(distortion=torch.ones(5)),
    "no distortion": _other_camera(distortion=None),
    "size": _other_camera(width=4, height=6),
    "instant": replace(FRAMES[0], frame_index=7),
    "camera": replace(FRAMES[0], camera_index=7),
}


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_another_frame_makes_other_points(tmp_path, made, other):
    _get(tmp_path)
    _get(tmp_path, (other, FRAMES[1]))
    assert len(made) == 2
    _get(tmp_path, (other, FRAMES[1]))
    assert len(made) == 2


@pytest.mark.parametrize(
    "tracks",
    [
        (),
        (replace(TRACK, name="bus"),),
        (replace(TRACK, frames=torch.tensor([0, 2])),),
        (replace(TRACK, world_from_object=TRACK.world_from_object @ TURN),),
        (replace(TRACK, size=2 * TRACK.size),),
    ],
    ids=["none", "name", "frames", "poses", "size"],
)
def test_other_boxes_make_other_points(tmp_path, made, tracks):
    _get(tmp_path)
    _get(tmp_path, tracks=tracks)
    assert len(made) == 2


def test_other_times_make_other_points_where_boxes_have_times(tmp_path, made):
    """A box at the time of a view lies between two annotated ones."""
    late = (FRAMES[0], replace(FRAMES[1], time=0.5))
    _get(tmp_path)
    _get(tmp_path, late)  # a log without a clock: the time says nothing that the frame does not
    assert len(made) == 1
    timed = replace(TRACK, times=torch.tensor([0.0, 0.5], dtype=torch.float64))
    later = replace(TRACK, times=torch.tensor([0.0, 0.6], dtype=torch.float64))
    for frames, track in ((FRAMES, timed), (FRAMES, later), (late, timed)):
        _get(tmp_path, frames, tracks=(track,))
    assert len(made) == 4


@pytest.mark.parametrize(
    "change",
    [
        {"features": 7}, {"epipolar_tolerance": 0.7}, {"ratio": 0.7}, {"max_error": 0.7}, {"min_views": 4},
        {"min_support": 0.7}, {"max_depth_error": 0.7},
    ],
    ids=str,
)  # fmt: skip
def test_other_settings_make_other_points(tmp_path, made, change):
    _get(tmp_path)
    _get(tmp_path, **change)
    assert len(made) == 2


def test_another_version_makes_other_points(tmp_path, made, monkeypatch):
    _get(tmp_path)
    monkeypatch.setattr(street, "VERSION", street.VERSION + 1)
    _get(tmp_path)
    assert len(made) == 2


def test_threads_make_the_same(tmp_path, made):
    _get(tmp_path)
    _get(tmp_path, threads=5)
    assert len(made) == 1


def test_an_interrupted_making_leaves_nothing(tmp_path, made, monkeypatch):
    def interrupted(path, points):
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(street, "_write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            _get(tmp_path)
    assert list(tmp_path.iterdir()) == []
    _get(tmp_path)
    assert len(made) == 2


def test_a_folder_that_cannot_be_written_is_told_of_before_any_work(tmp_path, made):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="cannot be written"):
        _get(tmp_path / "file")
    assert made == []
