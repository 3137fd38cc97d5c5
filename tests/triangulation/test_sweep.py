"""A plane sweep between painted walls whose places are known, seen by crooked drives."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from sparsestreet.data.lazy import as_frames
from sparsestreet.geometry.lenses import distort, undistort
from sparsestreet.kept import Kept
from sparsestreet.triangulation import ImagePointSettings, SweepSettings, TriangulatedPoints, kept_street_points
from sparsestreet.triangulation.sweep import partners, swept_points, thinned
from sparsestreet.types import Camera, Frame, Track, View

SETTINGS = SweepSettings()
pytestmark = pytest.mark.lengthy
SMALL = replace(SETTINGS, width=96)
"""A third of the pixels, and of the time."""
WIDTH, HEIGHT, FOCAL = 160, 96, 140.0
WALLS = (((0, -12, 0), (0, 1, 0)), ((0, 15, 0), (0, 1, 0)), ((110, 0, 0), (-1, 0, 0)))
"""(point, normal): 12 m to the right of the drive, 15 m to its left, and across it; x ahead, y left, z up."""
CLOUD = 1e5
"""Meters from here on is no wall."""
LATTICE = np.random.default_rng(7).uniform(0.05, 0.95, (3, 64, 64, 3))


def paint(spots: np.ndarray, wall: int) -> np.ndarray:
    """Colors of spots (across, up) on a wall, meters: noise of cells of 0.7, 1.9 and 5.1 m."""
    total = np.zeros((len(spots), 3))
    for channel in range(3):
        for octave, cell in enumerate((0.7, 1.9, 5.1)):
            at = spots.T / cell + 17.3 * wall
            total[:, channel] += map_coordinates(LATTICE[octave, ..., channel], at, order=1, mode="grid-wrap") / 3
    return total


def look(world_from_camera: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(colors, depth along the optical axis) of rays (x, y, 1) in the camera; depth 0 where there is no wall."""
    directions, eye = rays @ world_from_camera[:3, :3].T, world_from_camera[:3, 3]
    depth, colors = np.full(rays.shape[:-1], CLOUD), np.zeros(rays.shape)
    for wall, (point, normal) in enumerate(WALLS):
        with np.errstate(divide="ignore"):
            away = (np.array(point) - eye) @ normal / (directions @ normal)
        height = eye[2] + away * directions[..., 2]
        nearer = (away > 0) & (away < depth) & (height > -2) & (height < 25)  # the road below, the sky above
        spots = eye + away[nearer, None] * directions[nearer]
        colors[nearer] = paint(spots[:, [0 if normal[0] == 0 else 1, 2]], wall)
        depth[nearer] = away[nearer]
    return colors, np.where(depth < CLOUD, depth, 0)


def pose_at(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """world_from_camera: looks along x, turned by yaw degrees to the left."""
    angle = np.radians(yaw)
    ahead, left = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack((-left, (0, 0, -1), ahead), 1)
    pose[:3, 3] = (x, y, 0.0)
    return pose


def photograph(pose: np.ndarray, index: int, camera_index: int = 0, lens: torch.Tensor | None = None) -> tuple:
    """(frame, depth) of a camera, pixels of 2 x 2 rays."""
    intrinsics = torch.tensor([[FOCAL, 0, 78.0], [0, FOCAL, 50.0], [0, 0, 1]])
    camera = Camera(torch.from_numpy(np.linalg.inv(pose)).float(), intrinsics, WIDTH, HEIGHT, lens)

    def seen(side: int) -> tuple[np.ndarray, np.ndarray]:
        columns, rows = np.meshgrid((np.arange(WIDTH * side) + 0.5) / side, (np.arange(HEIGHT * side) + 0.5) / side)
        at = np.stack(((columns - 78.0) / FOCAL, (rows - 50.0) / FOCAL), -1)
        at = at if lens is None else undistort(torch.from_numpy(at), lens.double()).numpy()
        return look(pose, np.concatenate((at, np.ones((*at.shape[:-1], 1))), -1))

    colors = seen(2)[0].reshape(HEIGHT, 2, WIDTH, 2, 3).mean((1, 3))
    depth = seen(1)[1].astype(np.float32)
    frame = Frame(
        camera, index / 40, index, camera_index, image=torch.from_numpy((colors * 255).round().astype(np.uint8))
    )
    return frame, depth


def curve(x: float) -> np.ndarray:
    """A lane change of 2 m over 30 m, seen by a camera that follows it."""
    return pose_at(x, 1 - np.cos(np.pi * x / 30), np.degrees(np.arctan(np.pi / 30 * np.sin(np.pi * x / 30))))


LENS = torch.tensor([-0.08, 0.01, 0.001, -0.001, 0.0])


@pytest.fixture(scope="module")
def drive() -> list:
    """Two cameras that fire apart, with lenses and gaps: the second looks to the side."""
    places = [place for place in range(27) if place not in (9, 10, 23)]
    front = [photograph(curve(0.9 * place), place, 0, LENS) for place in places]
    side = [
        photograph(curve(0.9 * place + 0.4) @ np.linalg.inv(pose_at(0)) @ pose_at(0, yaw=80), place, 1)
        for place in places
    ]
    return [one for pair in zip(front, side, strict=True) for one in pair]


@pytest.fixture(scope="module")
def points(drive) -> TriangulatedPoints:
    return swept_points(as_frames([frame for frame, _ in drive]), [], SETTINGS)


@pytest.fixture(scope="module")
def small(drive) -> TriangulatedPoints:
    return swept_points(as_frames([frame for frame, _ in drive]), [], SMALL)


def from_walls(positions: np.ndarray) -> np.ndarray:
    """Meters to the nearest wall."""
    return np.min([np.abs((positions - np.array(point)) @ normal) for point, normal in WALLS], 0)


def errors(points: TriangulatedPoints, drive: list) -> np.ndarray:
    """Relative error of the depth of each point in the view that it was found in."""
    found = np.zeros(len(points))
    for place in np.unique(points.views):
        own, (frame, _) = points.views == place, drive[place]
        pose = frame.camera.camera_from_world.double().numpy()
        local = points.positions[own] @ pose[:3, :3].T + pose[:3, 3]
        true = look(np.linalg.inv(pose), local / local[:, 2:])[1]
        found[own] = np.where(true > 0, np.abs(local[:, 2] / np.maximum(true, 1e-9) - 1), np.inf)
    return found


def test_points_lie_on_the_walls(points, drive):
    found = errors(points, drive)
    assert len(points) > 5_000
    # planes are 2.5 % apart along the street; a pixel at the horizon of a wall is 2 % of its depth
    assert np.median(found) < 0.015
    assert np.mean(found < 0.05) > 0.95
    assert np.quantile(from_walls(points.positions), 0.9) < 3
    depths = FOCAL * points.pixel_sizes
    assert 20 < depths.min() < 21
    assert depths.max() < 180


def test_most_of_what_is_far_is_found(points, drive):
    places = np.unique(points.views)
    far = sum(int(((depth > 25) & (depth < 100)).sum()) for _, depth in (drive[place] for place in places))
    assert len(points) > 0.4 * far


def test_only_the_camera_that_looks_along_the_way_is_swept(points, drive):
    assert {drive[place][0].camera_index for place in points.views} == {0}


def test_a_camera_does_not_agree_with_another_that_shows_the_same(small, drive):
    """A second camera at the same place with the same images would agree in every pixel, right or wrong."""
    both = [one for frame, _ in drive[::2] for one in (frame, replace(frame, camera_index=2))]
    found = swept_points(as_frames(both), [], SMALL)
    assert len(found) == 2 * len(small)


def test_each_point_is_observed_at_the_pixel_that_shows_it(points, drive):
    assert points.observed.tolist() == list(range(len(points)))
    for place in np.unique(points.views)[::4]:
        own, (frame, _) = points.views == place, drive[place]
        pose = frame.camera.camera_from_world.double().numpy()
        local = points.positions[own] @ pose[:3, :3].T + pose[:3, 3]
        shown = distort(torch.from_numpy(local[:, :2] / local[:, 2:]), LENS.double()).numpy() * FOCAL + (78, 50)
        np.testing.assert_allclose(points.pixels[own], shown, atol=1e-2)
        column, row = points.pixels[own].astype(int).T
        # the swept image has no lens, so a point's color is between those of pixels
        assert np.median(np.abs(frame.image.numpy()[row, column] / 255 - points.colors[own])) < 0.02
        np.testing.assert_allclose(points.pixel_sizes[own], local[:, 2] / FOCAL, rtol=1e-4)


def test_each_cube_keeps_the_point_of_the_smallest_pixel():
    positions = np.array([[0.1, 0, 0], [0.9, 0, 0], [-0.1, 0, 0], [5.0, 5, 5], [0.5, 0.5, 0.5]], np.float32)
    sizes = np.array([0.3, 0.1, 0.2, 0.4, 0.1], np.float32)
    points = TriangulatedPoints(
        positions, positions, sizes, np.arange(5), np.array([4, 5, 6, 7, 8]), np.stack((sizes, sizes), 1)
    )
    left = thinned(points, 1.0)
    assert left.views.tolist() == [5, 6, 7]  # of two equal ones the first
    assert left.observed.tolist() == [0, 1, 2]
    assert left.positions.tolist() == positions[[1, 2, 3]].tolist()
    assert left.pixels[:, 0].tolist() == left.pixel_sizes.tolist() == sizes[[1, 2, 3]].tolist()
    assert len(thinned(points, 0.4)) == 5
    with pytest.raises(ValueError, match="one view each observes"):
        thinned(replace(points, observed=np.array([0, 0, 1, 2, 3])), 1.0)


def test_a_turned_and_shifted_world_has_the_same_points(small, drive):
    turn = np.eye(4)
    turn[:3, :3] = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn[:3, 0] *= np.linalg.det(turn[:3, :3])
    turn[:3, 3] = (300.0, -200.0, 50.0)
    frames = []
    for frame, _ in drive:
        pose = torch.from_numpy(frame.camera.camera_from_world.double().numpy() @ np.linalg.inv(turn))
        frames.append(replace(frame, camera=replace(frame.camera, camera_from_world=pose)))
    turned = swept_points(as_frames(frames), [], SMALL)
    assert abs(len(turned) - len(small)) < 0.01 * len(small)
    back = (turned.positions - turn[:3, 3]) @ turn[:3, :3]
    far = np.array([np.abs(small.positions - spot).sum(1).min() for spot in back[::37]])
    assert np.quantile(far, 0.95) < 0.01


def masked(drive: list, **masks: torch.Tensor) -> list[Frame]:
    return [replace(frame, **masks) for frame, _ in drive]


@pytest.mark.parametrize("name", ["sky", "ego"])
def test_nothing_is_found_behind_a_mask(small, drive, name):
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, 80:] = True
    left = swept_points(as_frames(masked(drive, **{name: mask})), [], SMALL)
    for place in np.unique(left.views):
        own, (frame, _) = left.views == place, drive[place]
        pose = frame.camera.camera_from_world.double().numpy()
        local = left.positions[own] @ pose[:3, :3].T + pose[:3, 3]
        assert (local[:, 0] / local[:, 2] < (81 - 78) / FOCAL).all()
    assert 0.3 * len(small) < len(left) < 0.7 * len(small)


def test_nothing_is_found_near_a_return(small, drive):
    """A return, of any depth, at the first point that each view has: 0.005 of 160 columns around it, and no more."""
    frames, near = [frame for frame, _ in drive], np.zeros(len(small), bool)
    for place in np.unique(small.views):
        own, depth = small.views == place, torch.zeros(HEIGHT, WIDTH)
        column, row = small.pixels[own][0].astype(int)
        depth[row, column] = 70.0
        frames[place] = replace(frames[place], depth=depth)
        near |= own & (np.abs(small.pixels.astype(int) - (column, row)) <= 1).all(1)
    left = swept_points(as_frames(frames), [], SMALL)
    assert near.sum() > len(np.unique(small.views))
    np.testing.assert_array_equal(left.positions, small.positions[~near])
    np.testing.assert_array_equal(left.views, small.views[~near])


def test_nothing_is_found_through_a_moving_box(small, drive):
    """A box of the right wall at all frames but the last swept one, where it stands elsewhere."""
    frames = torch.arange(32)
    poses = torch.eye(4, dtype=torch.float64).repeat(32, 1, 1)
    poses[:, :3, 3] = torch.tensor([60.0, -12.0, 5.0])
    last = drive[small.views.max()][0].frame_index
    poses[last, 0, 3] = -500.0
    box = Track("tram", "Vehicle", frames, poses, torch.tensor([20.0, 2.0, 40.0]))
    left = swept_points(as_frames([frame for frame, _ in drive]), [box], SMALL)

    def hidden(some: TriangulatedPoints, own: np.ndarray) -> int:
        x, y = some.positions[own, :2].T
        return int(((np.abs(x - 60) < 8) & (np.abs(y + 12) < 1)).sum())

    at_last, before = left.views == small.views.max(), small.views < small.views.max()
    assert hidden(small, before) > 50
    assert hidden(left, ~at_last) == 0
    assert hidden(left, at_last) == hidden(small, ~before)


def test_a_cloud_has_no_depth():
    """What is painted on the sky fits the farthest plane best."""

    def cloudy(place: int) -> Frame:
        pose = pose_at(0.9 * place)
        columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        at = np.stack(((columns - 78) / FOCAL, (rows - 50) / FOCAL), -1)
        colors = paint((at * 40).reshape(-1, 2), 0).reshape(HEIGHT, WIDTH, 3)
        frame, _ = photograph(pose, place)
        return replace(frame, image=torch.from_numpy((colors * 255).round().astype(np.uint8)))

    assert len(swept_points(as_frames([cloudy(place) for place in range(24)]), [], SETTINGS)) == 0


def test_a_pattern_that_repeats_is_left_out(monkeypatch):
    """Stripes every 5 m along a wall fit many planes."""

    def stripes(spots: np.ndarray, wall: int) -> np.ndarray:
        return np.repeat(0.5 + 0.4 * np.sin(2 * np.pi * spots[:, :1] / 5) * np.cos(spots[:, 1:] / 2), 3, 1)

    monkeypatch.setattr("tests.triangulation.test_sweep.paint", stripes)
    shots = [photograph(pose_at(0.9 * place), place) for place in range(24)]
    found = swept_points(as_frames([frame for frame, _ in shots]), [], SETTINGS)
    assert np.mean(errors(found, shots) > 0.1) < 0.2


def test_a_car_that_stands_sees_nothing(drive):
    frame = drive[0][0]
    frames = [replace(frame, frame_index=place, time=place / 20) for place in range(20)]
    found = swept_points(as_frames(frames), [], SETTINGS)
    assert len(found) == 0
    assert found.positions.shape == (0, 3)
    assert found.views.dtype.kind == "i"


def views(poses: list[np.ndarray], camera_index: int = 0) -> list[View]:
    cameras = [Camera(torch.from_numpy(np.linalg.inv(pose)).float(), torch.eye(3), 8, 6) for pose in poses]
    return [View(camera, place / 20, place, camera_index) for place, camera in enumerate(cameras)]


def test_views_are_compared_across_the_asked_distances():
    plan = partners(views([pose_at(x) for x in (0.0, 2.0, 4.0, 7.0, 13.0, 17.0, 50.0, 57.0)]), step=2.5)
    assert plan[0] == (3, 4)  # 6, 12 m; the one beyond 18 m is farther than MAX_BASELINE
    assert plan[2] == (4, 5)  # 9 m is the first from 6 m on, 13 m from 12 m on
    assert 1 not in plan  # 2 m after the one before
    assert 7 not in plan  # one view alone


def test_views_are_compared_along_their_way_alone():
    """A camera to the side, one that looks back, and one that turns about halfway."""
    places = [2.0 * place for place in range(24)]
    assert partners(views([pose_at(x, yaw=70) for x in places]), step=2.5) == {}
    assert partners(views([pose_at(x, yaw=180) for x in places]), step=2.5)[6] == (9, 12, 15, 3, 0)
    turning = partners(views([pose_at(x, yaw=0 if x < 24 else 60) for x in places]), step=2.5)
    assert sorted(turning) == [0, 2, 4, 6, 8, 10]
    assert max(other for others in turning.values() for other in others) == 11


def test_smaller_images_have_fewer_points_that_are_as_right(points, small, drive):
    assert 0.15 * len(points) < len(small) < 0.5 * len(points)
    assert np.median(errors(small, drive)) < 0.02
    # a point stands for a pixel as recorded, not for the larger one that was compared
    place = small.views[0]
    depth = small.positions[0] @ (axis := drive[place][0].camera.camera_from_world[2].numpy())[:3] + axis[3]
    np.testing.assert_allclose(small.pixel_sizes[0], depth / FOCAL, rtol=1e-4)


def test_a_street_starts_from_one_point_in_each_cube(tmp_path, drive):
    """And keeps all of them for the views that see them; threads change nothing."""
    frames, kept = as_frames([frame for frame, _ in drive[:40]]), Kept(tmp_path)
    plain = kept_street_points(kept, frames, [], ImagePointSettings(threads=1, features=200, sweep=None))
    points = kept_street_points(kept, frames, [], ImagePointSettings(threads=3, features=200, sweep=SMALL))
    alone = swept_points(frames, [], SMALL)
    assert plain.far is None
    assert (kept.made, kept.found) == (["points", "points"], [])
    np.testing.assert_array_equal(points.far.positions, alone.positions)
    added = thinned(alone, SMALL.spacing)
    assert 100 < len(added) < len(alone) / 2
    for name in ("positions", "colors", "pixel_sizes", "views", "pixels"):
        both = np.concatenate((getattr(plain.static, name), getattr(added, name)))
        np.testing.assert_array_equal(getattr(points.static, name), both)
    assert points.static.observed.tolist() == [*plain.static.observed, *(len(plain.static) + added.observed)]
    again = kept_street_points(kept, frames, [], ImagePointSettings(threads=1, features=200, sweep=SMALL))
    assert kept.found == ["points"]
    np.testing.assert_array_equal(again.far.pixels, alone.pixels)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"nearest": 0.0}, "0 < nearest < farthest"),
        ({"nearest": 200.0}, "0 < nearest < farthest"),
        ({"step": 0.0}, "step and spacing above 0"),
        ({"spacing": -1.0}, "step and spacing above 0"),
        ({"width": 4}, "at least 8 columns"),
        ({"min_score": 1.0}, "correlation"),
        ({"depth_weight": -0.1}, "depth_weight must be >= 0"),
    ],
)
def test_impossible_settings_are_refused(setting, said):
    with pytest.raises(ValueError, match=said):
        SweepSettings(**setting)
