"""From sightings to points, where every feature is made."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from sparsestreet.triangulation import ImagePointSettings
from sparsestreet.triangulation.matches import Features
from sparsestreet.triangulation.points import (
    Observations,
    Sighting,
    TriangulatedPoints,
    _reprojection,
    _solved,
    meet,
    relative_depth_error,
    reprojection_errors,
    triangulate,
)
from sparsestreet.triangulation.street import _from_box, _inside, _through
from sparsestreet.types import Track
from tests.triangulation.worlds import FOCAL, cloud, descriptors, imaged, pose, rail, sight, view
from tests.typed import there

SETTINGS = ImagePointSettings(threads=1)


def _sightings(points, described, poses, shown=None):
    """``shown`` holds, for each view, which points it shows; None: all that lie in its image."""
    shown = [np.ones(len(points), bool)] * len(poses) if shown is None else shown
    return [sight(points[own], described[own], at, i) for i, (at, own) in enumerate(zip(poses, shown, strict=True))]


def _world(count=60, views=4):
    rng = np.random.default_rng(0)
    points, described, poses = cloud(rng, count), descriptors(rng, count), rail(0.8 * np.arange(views))
    return points, described, poses


def _which(found, points):
    """The point of the world that each found one is; it must be one of them to 1 mm."""
    distance = np.linalg.norm(found.positions[:, None] - points, axis=2)
    assert distance.min(1, initial=0).max(initial=0) < 1e-3
    return distance.argmin(1) if len(found) else np.zeros(0, int)


def test_every_point_in_three_images_is_found_once():
    points, described, poses = _world()
    found = triangulate(_sightings(points, described, poses), SETTINGS)
    inside = np.array([imaged(points, at)[2] for at in poses])
    # Each of 4 views is compared with the next and the third: all but the second and the fourth meet.
    expected = np.flatnonzero(inside.all(0))
    assert len(expected) > 20
    assert set(expected) <= set(which := _which(found, points).tolist())
    assert len(which) == len(set(which))
    assert (inside.sum(0)[which] >= 3).all()


def test_observations_are_where_the_views_show_the_points():
    points, described, poses = _world()
    found = triangulate(_sightings(points, described, poses), SETTINGS)
    assert (np.bincount(found.observed) >= SETTINGS.min_views).all()
    for number, at in enumerate(poses):
        own = found.views == number
        _, pixels, inside = imaged(found.positions[found.observed[own]].astype(float), at)
        assert inside.all()
        # Float32 positions, 10 m away.
        np.testing.assert_allclose(found.pixels[own], pixels, atol=1e-3)
    assert len({*zip(found.observed.tolist(), found.views.tolist(), strict=True)}) == len(found.observed)


def test_colors_are_the_mean_and_sizes_those_of_the_nearest_view():
    points, described, _ = _world()
    poses = [pose(x=0.8 * i, z=0.4 * i) for i in range(4)]
    found = triangulate(_sightings(points, described, poses), SETTINGS)
    which = _which(found, points)
    assert len(found) > 10
    for number, world in enumerate(which):
        views = found.views[found.observed == number]
        base = world % 5 / 5
        # Colors of the world are the same in all views, but for the green that counts the views.
        np.testing.assert_allclose(found.colors[number], [base, base + views.mean() / 100, base], atol=1e-6)
        nearest = points[world, 2] - max(0.4 * view for view in views)
        np.testing.assert_allclose(found.pixel_sizes[number], nearest / FOCAL, rtol=1e-3)


def test_views_in_which_a_point_is_white_have_no_part_in_its_color():
    points, described, _ = _world()
    poses = [pose(x=0.8 * i, z=0.4 * i) for i in range(4)]
    sightings = _sightings(points, described, poses)
    white = [replace(one, colors=np.full_like(one.colors, 250 / 255)) for one in sightings]
    usual, some, none = (triangulate(made, SETTINGS) for made in (sightings[:], [*white[:2], *sightings[2:]], white))
    assert len(usual) == len(some) > 10
    for number in range(len(some)):
        seen = [view for view in some.views[some.observed == number] if view >= 2]
        green = usual.colors[number, 0] + np.mean(seen) / 100 if seen else 250 / 255
        np.testing.assert_allclose(some.colors[number, 1], green, atol=1e-5)
    np.testing.assert_allclose(none.colors, 250 / 255, atol=1e-6)


def test_a_row_of_equal_windows_gives_no_wrong_point():
    rng = np.random.default_rng(0)
    windows = np.stack((np.arange(-3, 6) * 0.7, np.zeros(9), np.full(9, 10.0)), 1)
    described = np.repeat(descriptors(rng, 1), 9, 0)
    described = described + rng.normal(size=described.shape).astype(np.float32) * 0.005
    described /= np.linalg.norm(described, axis=1, keepdims=True)
    _which(triangulate(_sightings(windows, described, rail(0.8 * np.arange(5))), SETTINGS), windows)


def _with_one_wrong(shown, wrong):
    """(points of a rail of 7 views of which some show them, the world's points); one has its features 8 pixels off."""
    points, described, poses = _world(views=7)
    views = [np.full(len(points), view in shown) for view in range(7)]
    sightings = _sightings(points, described, poses, views)
    sightings[wrong] = sight(points, described, poses[wrong], wrong, shift=8.0)
    everywhere = np.flatnonzero(np.all([imaged(points, at)[2] for at in poses], 0))
    assert len(everywhere) > 10
    return triangulate(sightings, replace(SETTINGS, min_support=0.0)), points, everywhere


def test_a_view_that_disagrees_is_dropped_and_the_point_kept():
    """View 3 was compared with 0, 2, 4 and 6, none of which were compared with each other; it goes on without 4."""
    found, points, everywhere = _with_one_wrong(shown=(0, 2, 3, 4, 6), wrong=4)
    assert 4 not in found.views
    assert set(everywhere) <= set(_which(found, points).tolist())


def test_a_point_whose_own_feature_disagrees_is_none():
    """View 3 alone gathers the others, and it is the one that is wrong."""
    assert len(_with_one_wrong(shown=(0, 2, 3, 4, 6), wrong=3)[0]) == 0


def test_a_point_that_has_too_few_views_left_is_none():
    assert len(_with_one_wrong(shown=(0, 1, 3), wrong=1)[0]) == 0


def test_a_point_that_most_of_the_compared_views_do_not_show_is_none():
    """Views 3, 4 and 6 agree on it, but 3 was compared with 0 and 2 as well, which look there and see nothing."""
    points, described = np.array([[2.4, 0.0, 12.0]]), descriptors(np.random.default_rng(0), 1)
    shown = [np.array([view in (3, 4, 6)]) for view in range(8)]
    sightings = _sightings(points, described, rail(0.8 * np.arange(8)), shown)
    assert len(triangulate(sightings, SETTINGS)) == 0
    assert len(triangulate(sightings, replace(SETTINGS, min_support=0.5))) == 1


@pytest.mark.parametrize(("views", "min_views", "found"), [(2, 2, True), (2, 3, False), (4, 3, True), (4, 4, False)])
def test_a_point_needs_so_many_views(views, min_views, found):
    """Of 4 views on a rail each is compared with 2 others, the next and the third: 3 can agree."""
    points, described, poses = _world(views=views)
    settings = replace(SETTINGS, min_views=min_views)
    assert (len(triangulate(_sightings(points, described, poses), settings)) > 0) == found


def test_a_point_without_parallax_is_too_uncertain():
    points, described, poses = _world()
    far = points * [20, 20, 20]
    sightings = _sightings(far, described, poses)
    # 2.4 m at 160 to 320 m: half a pixel is 10 % of the distance and more.
    assert len(triangulate(sightings, SETTINGS)) == 0
    assert len(triangulate(sightings, replace(SETTINGS, max_depth_error=0.5))) > 0


@pytest.mark.parametrize(("zoom", "found"), [(1.0, True), (2.0, False)])
def test_the_tolerance_is_in_pixels_of_the_second_image(zoom, found):
    """A feature 0.35 pixels off the line of a usual camera: 0.7 of one that has twice its focal length."""
    point, described = np.array([[0.4, 0.0, 12.0]]), descriptors(np.random.default_rng(0), 1)
    first, second = _sightings(point, described, rail([0.0, 0.8]))
    camera = second.view.camera
    zoomed = replace(camera, intrinsics=camera.intrinsics * torch.tensor([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]]))
    off = second.rays + np.array([0.0, 0.35 / FOCAL])
    second = replace(second, rays=off, view=replace(second.view, camera=zoomed))
    lenient = replace(SETTINGS, min_views=2, min_support=0.0, max_error=5.0, max_depth_error=1.0)
    settings = replace(lenient, epipolar_tolerance=0.5)
    assert (len(triangulate([first, second], settings)) > 0) == found


def test_features_that_are_off_by_more_than_the_limit_do_not_agree():
    points, described, poses = _world(views=4)
    settings = replace(SETTINGS, min_support=0.0, min_views=4)
    shifted = [sight(points, described, at, i, shift=4.0 * (i % 2)) for i, at in enumerate(poses)]
    assert len(triangulate(shifted, settings)) == 0


@pytest.mark.parametrize("count", [0, 1, 4])
def test_views_without_features_give_no_points(count):
    sightings = [
        sight(np.zeros((0, 3)), np.zeros((0, 128), np.float32), at, i) for i, at in enumerate(rail(range(count)))
    ]
    found = triangulate(sightings, SETTINGS)
    assert (len(found), found.colors.shape, found.pixels.shape) == (0, (0, 3), (0, 2))


def test_a_camera_that_stands_or_turns_on_the_spot_gives_no_points():
    points, described, _ = _world()
    for poses in ([pose()] * 5, [pose(yaw=2.0 * i) for i in range(5)]):
        assert len(triangulate(_sightings(points, described, poses), SETTINGS)) == 0


def test_threads_do_not_change_the_points_and_progress_is_told():
    points, described, poses = _world()
    told = []
    one = triangulate(_sightings(points, described, poses), SETTINGS, lambda *step: told.append(step))
    two = triangulate(_sightings(points, described, poses), replace(SETTINGS, threads=2))
    assert np.array_equal(one.positions, two.positions)
    assert told == [(done, 4) for done in range(1, 5)]


def test_cameras_of_one_instant_count_once():
    """Two cameras that show a point at one instant only are two views of it, not three."""
    points, described, _ = _world()
    sightings = _sightings(points, described, rail([0.0, 1.5]))
    sightings[1] = replace(sightings[1], view=replace(sightings[1].view, frame_index=0, camera_index=1))
    settings = replace(SETTINGS, max_depth_error=0.1)
    assert len(triangulate(sightings, settings)) == 0
    assert len(triangulate(sightings, replace(settings, min_views=2))) > 0


@pytest.mark.parametrize(("name", "value"), [("min_views", 1), ("features", 0), ("threads", 0)])
def test_settings_that_cannot_be_are_refused(name, value):
    with pytest.raises(ValueError, match=f"at least .*, got {value}"):
        ImagePointSettings(**{name: value})


def _observed(points, poses, rng, views=4):
    """Each point in some of the poses, all of which look at it."""
    chosen = np.concatenate([rng.choice(len(poses), views, replace=False) for _ in points])
    point = np.repeat(np.arange(len(points)), views)
    rays = np.array([imaged(points[[p]], poses[v])[0][0] for p, v in zip(point, chosen, strict=True)])
    return Observations(point, np.array(poses)[chosen], rays, np.full(len(rays), FOCAL))


@pytest.fixture
def poses():
    return [pose(x=x, z=z, yaw=yaw) for x, z, yaw in [(0, 0, 0), (1, 0.5, -4), (2, 0, 5), (3, 1, -9), (-1, 1.5, 8)]]


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform((-3, -2, 8), (5, 2, 40), (200, 3))


def test_rays_without_noise_meet_in_their_point(poses, points):
    rng = np.random.default_rng(1)
    observations = _observed(points, poses, rng)
    met = meet(observations, len(points))
    # Float64 keeps 16 digits; the square of a depth over a baseline (40 / 1) costs 3, the normal matrix as many again.
    np.testing.assert_allclose(met, points, rtol=0, atol=1e-9 * 40)
    error, depth = reprojection_errors(observations, met)
    assert error.max() < 1e-6
    assert (depth > 5).all()


def test_the_position_is_that_of_a_general_solver(poses, points):
    rng = np.random.default_rng(2)
    clean = _observed(points[:10], poses, rng)
    noisy = clean.rays + rng.normal(size=clean.rays.shape) * 0.5 / FOCAL
    observations = Observations(clean.point, clean.camera_from_frame, noisy, clean.focal)
    met = meet(observations, 10)
    for number in range(10):
        own = observations.where(observations.point == number)
        own = Observations(np.zeros_like(own.point), own.camera_from_frame, own.rays, own.focal)
        solved = least_squares(
            lambda x, own=own: _reprojection(own, x[None])[0].ravel(), points[number], xtol=1e-14, ftol=1e-14
        )
        # Gauss-Newton stops after 4 steps: far below the noise, which moves a point by centimeters.
        np.testing.assert_allclose(met[number], solved.x, rtol=0, atol=1e-4)


def test_the_derivative_of_the_reprojection_is_that_of_finite_differences(poses, points):
    observations = _observed(points, poses, np.random.default_rng(3))
    moved = points + 0.1
    jacobian = _reprojection(observations, moved)[1]
    step = 1e-5
    for axis in range(3):
        offset = step * np.eye(3)[axis]
        after, before = (_reprojection(observations, moved + sign * offset)[0] for sign in (1, -1))
        # Central differences: an error of step^2 of values of some 30 pixels a meter, and rounding over the step.
        np.testing.assert_allclose(jacobian[:, :, axis], (after - before) / (2 * step), atol=1e-5)


@pytest.mark.lengthy
def test_the_predicted_error_is_that_of_drawn_noise(poses):
    """One point, seen in 4 views 4000 times: the spread along its least certain direction, over its distance."""
    rng = np.random.default_rng(4)
    draws, noise, point = 4000, 0.5, np.array([[1.0, 0.5, 20.0]])
    clean = _observed(np.repeat(point, draws, 0), poses[:4], rng)
    noisy = clean.rays + rng.normal(size=clean.rays.shape) * noise / FOCAL
    observations = Observations(clean.point, clean.camera_from_frame, noisy, clean.focal)
    met = meet(observations, draws)
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(met.T))[-1])
    nearest = min(np.linalg.norm(point[0] - _center(camera)) for camera in poses[:4])
    predicted = np.median(relative_depth_error(observations, met, noise))
    # A standard deviation of 4000 draws is known to 1 / sqrt(8000) = 1.1 %.
    assert predicted == pytest.approx(spread / nearest, rel=0.05)
    np.testing.assert_allclose(met.mean(0), point[0], atol=5 * spread / np.sqrt(draws) + 0.01)


def _center(camera_from_world):
    return np.linalg.inv(camera_from_world)[:3, 3]


@pytest.mark.parametrize("apart", [0.0, 1e-9, -0.002], ids=["parallel", "almost", "diverging"])
def test_rays_that_do_not_meet_give_a_finite_point_that_is_not_believed(apart):
    rays = np.array([[0.1, 0.05], [0.1 + apart, 0.05]])
    observations = Observations(np.zeros(2, int), np.array([pose(x=1.0), pose()]), rays, np.full(2, FOCAL))
    met = meet(observations, 1)
    assert np.isfinite(met).all()
    error, depth = reprojection_errors(observations, met)
    agreed = (error < 0.6).all() and (depth > 0.5).all()
    assert not (agreed and relative_depth_error(observations, met, 0.5)[0] < 0.03)


def test_the_order_of_observations_does_not_matter(poses, points):
    rng = np.random.default_rng(5)
    observations = _observed(points, poses, rng)
    met = meet(observations.where(rng.permutation(len(observations))), len(points))
    np.testing.assert_allclose(met, meet(observations, len(points)), rtol=0, atol=1e-9 * 40)


def test_a_point_that_nothing_shows_is_at_the_origin_and_nothing_is_known_of_it(poses, points):
    some = _observed(points[:1], poses, np.random.default_rng(6))
    later = Observations(some.point + 1, some.camera_from_frame, some.rays, some.focal)
    met = meet(later, 2)
    assert (met[0] == 0).all()
    np.testing.assert_allclose(met[1], points[0], atol=1e-6)
    assert np.isinf(relative_depth_error(later, met, 0.5)[0])
    nothing = later.where(np.zeros(len(later), bool))
    assert meet(nothing, 0).shape == (0, 3)
    assert relative_depth_error(nothing, np.zeros((0, 3)), 0.5).shape == (0,)


def test_a_point_behind_a_camera_has_a_negative_depth():
    observations = Observations(np.zeros(1, int), pose()[None], np.zeros((1, 2)), np.array([FOCAL]))
    assert reprojection_errors(observations, np.array([[0.0, 0.0, -5.0]]))[1] == -5


def test_a_direction_that_nothing_determines_is_damped_by_a_billionth_of_the_trace():
    """1e-9 times the trace 2: what pulls as strongly moves a point by 1, what is determined is not changed."""
    solved = _solved(np.diag([1.0, 1.0, 0.0])[None], np.array([[3.0, -4.0, 2e-9]]))
    # Another 1e-12 stands beside the 2e-9.
    np.testing.assert_allclose(solved, [[3.0, -4.0, 1.0]], rtol=1e-3)


BOX = Track("car", "Car", torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None], torch.tensor([4.0, 2.0, 1.5]))


def test_what_is_behind_the_camera_is_not_seen_through():
    """The box lies at the origin; one camera looks at it from 6 m, the other away from it. Rays: ahead and aside."""
    rays = np.array([[0.0, 0.0], [0.9, 0.0]])
    for place, seen in ((-6.0, [True, False]), (6.0, [False, False])):
        at = pose(z=place)
        features = Features(np.zeros((2, 2)), descriptors(np.random.default_rng(0), 2))
        sighting = Sighting(view(at, 0), at, features, rays, np.zeros((2, 3), np.float32))
        assert _through(sighting, BOX).tolist() == seen


def test_points_of_a_box_name_the_views_that_were_given():
    """It was annotated in the views 3, 5 and 8; the second point lies outside of it."""
    positions = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [1.0, 0.5, 0.5]], np.float32)
    observed, views = np.array([0, 0, 1, 2, 2]), np.array([0, 2, 1, 1, 2])
    pixels = np.arange(10, dtype=np.float32).reshape(5, 2)
    points = TriangulatedPoints(positions, positions, positions[:, 0], observed, views, pixels)
    found = _inside(points, [3, 5, 8], BOX)
    assert found.positions.tolist() == positions[[0, 2]].tolist()
    assert found.observed.tolist() == [0, 0, 1, 1]
    assert found.views.tolist() == [3, 8, 5, 8]
    assert found.pixels.tolist() == pixels[[0, 1, 3, 4]].tolist()


def test_a_box_is_where_it_is_when_the_image_is_taken():
    """The box drives 2 m from frame 0 to frame 1; the image of frame 0 is taken a quarter of the way."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 2.0
    times = torch.tensor([0.0, 0.8], dtype=torch.float64)
    track = replace(BOX, frames=torch.tensor([0, 1]), world_from_object=poses, times=times)
    at = pose(z=-6.0)
    features = Features(np.zeros((0, 2)), descriptors(np.random.default_rng(0), 0))
    seen = replace(view(at, 0), time=0.2)
    sighting = Sighting(seen, at, features, np.zeros((0, 2)), np.zeros((0, 3), np.float32))
    moved = there(_from_box(sighting, track)).camera_from_frame @ np.linalg.inv(at)
    np.testing.assert_allclose(moved[:3, 3], at[:3, :3] @ (0.5, 0, 0), atol=1e-12)
    assert _from_box(replace(sighting, view=replace(seen, frame_index=2)), track) is None
