"""What the images show, counted by hand: 25 x 20 pixels, where "near" is a window of 3 x 3."""

from collections import Counter
from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Frames, as_frames
from sparsestreet.scene.initialize.training_data import VIEWS, Coverage, TrainingData, beyond_lidar, coverage
from sparsestreet.triangulation import StreetPoints
from sparsestreet.types import Frame, SparsePoints, View
from tests.scene.street import camera_at, street_log, triangulated

WIDTH, HEIGHT = 25, 20


def frame(returns: list[tuple[int, int]] | None = None, sky_rows: int | None = None, index: int = 0) -> Frame:
    """A frame with returns at some (column, row), and sky down to a row; None: without lidar, without sky mask."""
    depth = sky = None
    if returns is not None:
        depth = torch.zeros(HEIGHT, WIDTH)
        for column, row in returns:
            depth[row, column] = 7.0
    if sky_rows is not None:
        sky = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
        sky[:sky_rows] = True
    image = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    return Frame(camera_at(0.0, WIDTH, HEIGHT), 0.0, index, 0, image=image, sky=sky, depth=depth)


def data_of(*frames: Frame, points=None) -> TrainingData:
    found = None if points is None else StreetPoints(points, {})
    return TrainingData(street_log(), as_frames(frames), frozenset(), image_points=found)


def test_shares_by_hand():
    # 15 rows of 25 pixels are no sky. The window around the first return holds 9 of them; that in the corner below the
    # sky 2 columns of 2 rows. The first point's window has 3 pixels that the first return's has not, the second's 9.
    first = frame([(10, 10), (0, 5)], sky_rows=5)
    points = triangulated([[0.0] * 3] * 3, [(0, 0, 11.7, 10.2), (1, 0, 20.0, 15.9), (2, 1, 3.5, 3.5)])
    # In the second frame all is sky: what is near a return or a point there does not count.
    second = frame([(3, 3)], sky_rows=HEIGHT)
    seen = coverage(data_of(first, second, points=points))
    assert seen == Coverage(lidar=13 / 375, images=12 / 375)
    assert seen.nothing == pytest.approx(350 / 375)


def test_without_sky_mask_every_pixel_counts():
    assert coverage(data_of(frame([(10, 10)]))) == Coverage(lidar=9 / 500, images=0.0)


def test_the_recording_car_is_no_part_of_the_scene():
    hood = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hood[11:] = True
    points = triangulated([[0.0] * 3], [(0, 0, 20.0, 15.9)])
    # The lowest row of the window around the return is of the hood, as is all around the point.
    assert coverage(data_of(replace(frame([(10, 10)]), ego=hood), points=points)) == Coverage(6 / 275, 0.0)


def test_without_lidar_points_from_images_count_alone():
    points = triangulated([[0.0] * 3], [(0, 0, 0.5, 0.5)])
    assert coverage(data_of(frame(), points=points)) == Coverage(lidar=0.0, images=4 / 500)


def test_points_of_the_log_count_where_they_are_seen():
    """One lies behind the camera; the others in the middle of the image and in its top left corner."""
    view = frame(sky_rows=1)
    (fx, _, cx), (_, fy, cy), _ = view.camera.intrinsics.tolist()
    at = torch.tensor([[0.0, 0, 4], [4 * (0.5 - cx) / fx, 4 * (0.5 - cy) / fy, 4], [0, 0, -4]])
    world_from_camera = torch.linalg.inv(view.camera.camera_from_world)
    sparse = SparsePoints(at @ world_from_camera[:3, :3].T + world_from_camera[:3, 3], torch.zeros(3, 3))
    data = replace(data_of(view), log=replace(street_log(), sparse_points=lambda: sparse))
    # Windows of 9, and of 4 without the sky's 2.
    assert coverage(data) == Coverage(lidar=0.0, images=11 / 475)
    # The lidar's window of 3 x 3 overlaps that of the middle in 3 pixels.
    returned = replace(data, frames=as_frames([replace(view, depth=frame([(10, 10)]).depth)]))
    middle = (int(cx), int(cy))
    shared = max(0, 3 - abs(middle[0] - 10)) * max(0, 3 - abs(middle[1] - 10))
    assert coverage(returned) == Coverage(lidar=9 / 475, images=(11 - shared) / 475)
    assert shared > 0
    # A triangulated point far from both.
    both = replace(data, image_points=StreetPoints(triangulated([[0.0] * 3], [(0, 0, 20.5, 15.5)]), {}))
    assert coverage(both) == Coverage(lidar=0.0, images=20 / 475)


@pytest.mark.parametrize("frames", [[frame()], [frame([(1, 1)], sky_rows=HEIGHT)], []], ids=["bare", "sky", "no view"])
def test_where_nothing_tells_all_is_uncovered(frames: list[Frame]):
    seen = coverage(data_of(*frames, points=triangulated([])))
    assert seen == Coverage(lidar=0.0, images=0.0)
    assert seen.nothing == 1


def test_of_many_views_some_of_every_camera_are_looked_at():
    """108 views of three cameras in turn; the lidar covers all of one camera's pixels, nothing of the others'."""
    loaded = []
    everywhere = frame([(column, row) for column in range(WIDTH) for row in range(HEIGHT)])

    def load(view: View) -> Frame:
        loaded.append(view.camera_index)
        return replace(everywhere if view.camera_index == 0 else frame([]), camera_index=view.camera_index)

    views = [View(camera_at(0.0), 0.0, index // 3, index % 3) for index in range(108)]
    seen = coverage(TrainingData(street_log(), Frames(views, load), frozenset()))
    times = Counter(loaded)
    assert len(loaded) == VIEWS
    assert all(14 <= times[camera] <= 18 for camera in range(3))
    assert seen.lidar == times[0] / VIEWS


def test_points_beyond_the_lidar_have_no_return_near_in_any_view():
    frames = [frame([(10, 10)]), frame(), frame([(5, 5)])]
    seen = [
        *[(0, 0, 11.5, 9.5), (0, 1, 1.5, 1.5)],  # near in the first view
        *[(1, 0, 12.5, 10.5), (1, 1, 5.5, 5.5)],  # two pixels off; the second view has no lidar
        *[(2, 0, 1.5, 1.5), (2, 2, 4.2, 6.8)],  # near in the last view
    ]
    points = triangulated([[0.0] * 3] * 4, seen)  # the fourth is seen nowhere
    assert beyond_lidar(data_of(*frames), points).tolist() == [False, True, False, True]
    assert beyond_lidar(data_of(*frames), triangulated([])).tolist() == []
