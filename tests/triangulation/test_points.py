"""From sightings to points, where every feature is made."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.triangulation import ImagePointSettings
from sparsestreet.triangulation.points import triangulate
from tests.triangulation.worlds import FOCAL, cloud, descriptors, imaged, pose, rail, sight

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
    for view, at in enumerate(poses):
        own = found.views == view
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
