"""Points of a street whose depth is known at every pixel, and of bad pictures of it."""

import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import Frames, as_frames
from sparsestreet.data.synthetic.tracer import BACKGROUND
from sparsestreet.geometry.lenses import distort
from sparsestreet.kept import Kept
from sparsestreet.triangulation import (
    ImagePointSettings,
    StreetPoints,
    TriangulatedPoints,
    kept_street_points,
    street,
    street_points,
)
from sparsestreet.triangulation.matches import Features
from sparsestreet.triangulation.street import _pixel, _rays, _sighting
from sparsestreet.types import Camera, Frame, Track
from tests.triangulation.conftest import traced

SETTINGS = ImagePointSettings(threads=1)
pytestmark = pytest.mark.lengthy


def _moving(log):
    return [track for track in log.tracks if track.path_length > 1]


@pytest.fixture(scope="module")
def points(street):
    return street_points(street.frames, _moving(street), SETTINGS)


def _truth(log, place):
    """(depth, instance) of a view, exact for the ray through each pixel's center."""
    view = log.views[place]
    with np.load(Path(log.name) / "depth" / f"{view.frame_index:03d}_{view.camera_index}.npz") as truth:
        return truth["depth"], truth["instance"]


def _ids(log, tracks):
    """Numbers in the truth of some tracks."""
    said = json.loads((Path(log.name) / "instances" / "instances_info.json").read_text())
    return {track.name: int(key) for key, one in said.items() for track in tracks if track.name in (one["id"], key)}


def _depths(points, log, place):
    """(depths of the points that a view observes, their pixels' columns and rows, their numbers)."""
    own = points.views == place
    pose = log.views[place].camera.camera_from_world.double().numpy()
    local = points.positions[points.observed[own]] @ pose[:3, :3].T + pose[:3, 3]
    return local[:, 2], points.pixels[own].astype(int), points.observed[own]


def _errors(points, log):
    """For each observation the relative error of the depth, of the best surface within one pixel."""
    errors = np.full(len(points.observed), np.inf)
    for place in range(len(log.views)):
        depths, pixels, _ = _depths(points, log, place)
        true = np.pad(_truth(log, place)[0], 1)
        around = [true[pixels[:, 1] + row, pixels[:, 0] + column] for row in range(3) for column in range(3)]
        around = np.where(np.array(around) > 0, around, np.nan)
        errors[points.views == place] = np.nanmin(np.abs(depths / around - 1), 0)
    return errors


def test_points_lie_on_the_surfaces_that_the_views_show(street, points):
    errors = _errors(points.static, street)
    assert len(points.static) > 100
    assert np.median(errors) < 0.02
    # 160 pixels are coarse: what is a meter deep is a pixel wide, and features lie on its outline.
    assert (errors < 0.1).mean() > 0.9
    assert errors.max() < 3


@pytest.mark.slow
def test_points_of_larger_images_are_as_good_as_the_street_is_drawn(tmp_path):
    log = traced(tmp_path / "street", num_frames=12)
    errors = _errors(street_points(log.frames, _moving(log), ImagePointSettings()).static, log)
    assert np.median(errors) < 0.02
    assert (errors < 0.1).mean() > 0.95


def test_no_point_is_in_the_sky_or_on_what_moves(street, points):
    moving = list(_ids(street, _moving(street)).values())
    assert moving
    for place in range(len(street.views)):
        _, (column, row) = None, _depths(points.static, street, place)[1].T
        depth, instance = _truth(street, place)
        assert (depth[row, column] > 0).all()
        assert not np.isin(instance[row, column], moving).any()


def test_no_feature_is_of_the_recording_car(street):
    frame, hood = street.frames[0], torch.zeros(96, 160, dtype=torch.bool)
    hood[60:] = True
    rows = [_sighting(frame, replace(frame, ego=ego), 500).features.pixels[:, 1] for ego in (None, hood)]
    assert rows[0].max() > 60 > rows[1].max() > 0


def test_points_of_a_box_are_in_it_and_on_its_object(street, points):
    """Seen from every view that has the box: where it is not hidden, the object is within a pixel."""
    ids, tracks = _ids(street, _moving(street)), {track.name: track for track in _moving(street)}
    assert set(points.in_boxes) == set(tracks)
    hits = []
    for name, found in points.in_boxes.items():
        track = tracks[name]
        assert (np.abs(found.positions) <= 0.55 * track.size.numpy() + 1e-6).all()
        for place in np.unique(found.views):
            _, instance = _truth(street, int(place))
            column, row = found.pixels[found.views == place].astype(int).T
            padded = np.pad(instance, 1, constant_values=BACKGROUND)
            near = np.array([padded[row + i, column + j] for i in range(3) for j in range(3)])
            hits.append((near == ids[name]).any(0))
            projected = _projected(found.positions[found.observed[found.views == place]], street.views[place], track)
            np.testing.assert_allclose(projected, found.pixels[found.views == place], atol=SETTINGS.max_error)
    hits = np.concatenate(hits)
    assert len(hits) > 100
    # The ground under a car is in its box, too, and moves with its shadow.
    assert hits.mean() > 0.9


def _projected(positions, view, track):
    """Pixels of points of a box, by its pose at the instant of a view."""
    pose = track.world_from_object[track.frames.tolist().index(view.frame_index)].numpy()
    local = positions @ pose[:3, :3].T + pose[:3, 3]
    camera = view.camera.camera_from_world.double().numpy()
    seen = (local @ camera[:3, :3].T + camera[:3, 3]) @ view.camera.intrinsics.double().numpy().T
    return seen[:, :2] / seen[:, 2:]


def _changed(log, change, count=None):
    """The first frames of the log, each as ``change`` makes it."""
    return as_frames(tuple(change(frame) for frame in list(log.frames)[:count]))


def _with_pose(frame, pose):
    return replace(frame, camera=replace(frame.camera, camera_from_world=pose))


def test_a_standing_camera_and_one_that_turns_on_the_spot_give_nothing(street):
    first = street.frames[0]
    still = _changed(street, lambda frame: _with_pose(first, first.camera.camera_from_world), 4)
    assert len(street_points(still, [], SETTINGS).static) == 0
    turn = torch.eye(4)
    turn[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, 0, 0.1], [0, 0, 0], [-0.1, 0, 0]]))
    turned = as_frames((first, _with_pose(first, turn @ first.camera.camera_from_world)))
    assert len(street_points(turned, [], SETTINGS).static) == 0


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_frames_are_too_few(street, count):
    found = street_points(_changed(street, lambda frame: frame, count), _moving(street), SETTINGS)
    assert len(found.static) == 0
    assert {len(part) for part in found.in_boxes.values()} == {0}


def test_night_and_noise_give_no_points_of_nothing(street):
    generator = torch.Generator().manual_seed(0)

    def night(frame):
        noise = torch.randn(frame.image.shape, generator=generator)
        return replace(frame, image=(0.03 * frame.image + noise).clamp(0, 255).to(torch.uint8))

    black = _changed(street, lambda frame: replace(frame, image=torch.zeros_like(frame.image)))
    assert len(street_points(black, _moving(street), SETTINGS).static) == 0
    errors = _errors(street_points(_changed(street, night), _moving(street), SETTINGS).static, street)
    assert len(errors) < 60
    assert (errors < 0.3).mean() > 0.5 if len(errors) else True


def test_poses_that_are_5_cm_off_give_fewer_points_and_no_others(street, points):
    generator = torch.Generator().manual_seed(0)

    def shaken(frame):
        pose = frame.camera.camera_from_world.clone()
        pose[:3, 3] += 0.05 * torch.randn(3, generator=generator)
        return _with_pose(frame, pose)

    found = street_points(_changed(street, shaken), _moving(street), SETTINGS).static
    assert len(found) < 0.7 * len(points.static)


def test_rays_are_those_of_a_lens_without_distortion():
    intrinsics = torch.tensor([[277.0, 0, 160], [0, 270.0, 96], [0, 0, 1]])
    lens = torch.tensor([-0.3, 0.1, 0.001, -0.002, 0.01])
    camera = Camera(torch.eye(4), intrinsics, 320, 192, lens)
    rays = torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    imaged = distort(rays, lens.double()) @ intrinsics[:2, :2].double().T + intrinsics[:2, 2].double()
    np.testing.assert_allclose(_rays(imaged.numpy(), camera), rays.numpy(), atol=1e-9)
    assert np.abs(_rays(imaged.numpy(), replace(camera, distortion=None)) - rays.numpy()).max() > 0.01


def test_a_feature_takes_the_pixel_that_it_lies_in():
    """Of 5 x 3 pixels; a feature on the far border, or interpolated to beyond it, takes the last one."""
    camera = Camera(torch.eye(4), torch.eye(3), 5, 3)
    places = np.array([[3.7, 2.2], [0.0, 0.9], [5.0, 3.0], [-0.1, 3.2]])
    row, column = _pixel(Features(places, np.zeros((4, 128), np.float32)), camera)
    assert (row.tolist(), column.tolist()) == ([2, 0, 2, 2], [3, 0, 4, 0])


def test_threads_change_no_point(street, points):
    """They decode images at the same time. The usual number is torch's, which may be any."""
    for threads in (2, 5, None):
        again = street_points(street.frames, _moving(street), replace(SETTINGS, threads=threads))
        assert list(again.in_boxes) == list(points.in_boxes)
        for one, other in zip(
            (points.static, *points.in_boxes.values()), (again.static, *again.in_boxes.values()), strict=True
        ):
            assert vars(one).keys() == vars(other).keys()
            assert all(np.array_equal(vars(one)[name], vars(other)[name]) for name in vars(one))


def test_images_are_decoded_at_the_same_time(street):
    """Two threads meet in the midst of it."""
    both = threading.Barrier(2, timeout=60)

    def load(frame):
        both.wait()
        return frame

    street_points(Frames(list(street.frames)[:6], load), [], replace(SETTINGS, threads=2, features=20))


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


def _get(folder, tracks=(TRACK,), **changes):
    return kept_street_points(Kept(folder), as_frames(FRAMES), tracks, ImagePointSettings(**changes))


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


BOXES = {
    "none": (),
    "name": (replace(TRACK, name="bus"),),
    "frames": (replace(TRACK, frames=torch.tensor([0, 2])),),
    "poses": (replace(TRACK, world_from_object=TRACK.world_from_object @ TURN),),
    "size": (replace(TRACK, size=2 * TRACK.size),),
    "times": (replace(TRACK, times=torch.tensor([0.0, 0.5], dtype=torch.float64)),),
    "other times": (replace(TRACK, times=torch.tensor([0.0, 0.6], dtype=torch.float64)),),
}
LIMITS = {
    "features": 7, "epipolar_tolerance": 0.7, "ratio": 0.7, "max_error": 0.7, "min_views": 4, "min_support": 0.7,
    "max_depth_error": 0.7,
}  # fmt: skip


def test_other_boxes_and_settings_make_other_points(tmp_path, made, monkeypatch):
    """Threads make the same; images are a matter of the log (tests/cli/test_twice.py)."""
    _get(tmp_path)
    for tracks in BOXES.values():
        _get(tmp_path, tracks)
    for name, limit in LIMITS.items():
        _get(tmp_path, **{name: limit})
    assert len(made) == 1 + len(BOXES) + len(LIMITS)
    _get(tmp_path, threads=5)
    assert len(made) == 1 + len(BOXES) + len(LIMITS)
    monkeypatch.setattr(street.cv2, "__version__", "5.1")
    _get(tmp_path)
    assert len(made) == 2 + len(BOXES) + len(LIMITS)
