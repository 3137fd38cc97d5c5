"""Where a camera drives."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.export.path import (
    cropped,
    left_to_right,
    of_cameras,
    of_frames,
    pinholes,
    raised,
    recorded,
    resampled,
    resized,
    shifted,
)
from sparsestreet.geometry.cameras import project
from sparsestreet.geometry.trajectories import frame_periods
from tests.export.street import NUM_FRAMES, street_views
from tests.typed import there

STEP = 1 / (NUM_FRAMES - 1)


def test_recorded_views_are_rigs_in_order_of_time():
    path = recorded(street_views()[::-1])
    assert [rig[0].frame_index for rig in path] == [0, 1, 2, 3, 4]
    assert [view.camera_index for view in path[2]] == [0, 1, 2, 3]
    assert {view.time for view in path[3]} == {0.75}


def test_seconds_go_with_time_and_a_stamp_with_what_was_recorded():
    """Frame f at 0.1 f seconds, by cameras that fire 10 ms after one another; a lens stays too."""
    lens = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0])
    views = [
        replace(
            view,
            camera=replace(view.camera, distortion=lens),
            seconds=0.1 * view.indices[0] + 0.01 * view.indices[1],
            stamp=7 + view.indices[0],
        )
        for view in street_views()
    ]
    path = recorded(views)
    for changed in (shifted(path, 1.0), resampled(path, STEP / 2), resized(path, 20)):
        assert torch.equal(there(changed[1][0].camera.distortion), lens)
    for rig in (resized(path, 24)[3], shifted(path, 1.5)[3]):
        assert [(view.seconds, view.stamp) for view in rig] == [(view.seconds, 10) for view in path[3]]
    between = resampled(path, STEP / 2)[3]
    # Halves of sums of two roundings.
    assert [view.seconds for view in between] == pytest.approx([0.15, 0.16, 0.17, 0.18], abs=1e-12)
    assert {view.stamp for view in between} == {None}
    assert {view.seconds for view in resampled(recorded(street_views()), STEP / 2)[3]} == {None}


def test_a_shift_needs_the_front_camera_all_the_time():
    views = [view for view in street_views() if (view.frame_index, view.camera_index) != (4, 0)]
    with pytest.raises(ValueError, match=r"no camera 0 in frame 4, only \[1, 2, 3\]"):
        shifted(recorded(views), 1.0)


def test_frames_and_cameras_choose():
    path = recorded(street_views())
    assert [rig[0].frame_index for rig in of_frames(path, slice(1, 3))] == [1, 2]
    assert [rig[0].frame_index for rig in of_frames(path, slice(None, 2))] == [0, 1]
    assert [rig[0].frame_index for rig in of_frames(path, slice(3, None))] == [3, 4]
    assert [view.camera_index for view in of_cameras(path, [3, 0])[4]] == [3, 0]
    single = of_frames(path, slice(1, 2))
    assert resampled(single, 0.01) == single
    with pytest.raises(ValueError, match="frames 7 to 9: the path has 0 to 4"):
        of_frames(path, slice(7, 9))
    lacking = recorded(street_views()[:-1])
    with pytest.raises(ValueError, match=r"no camera 3 in frame 4, only \[0, 1, 2\]: choose other cameras or frames"):
        of_cameras(lacking, [0, 3])
    assert len(of_cameras(lacking, [0, 2])) == NUM_FRAMES
    with pytest.raises(ValueError, match="got none"):
        recorded([])
    with pytest.raises(ValueError, match=r"no camera 5 in frame 0, only \[0, 1, 2, 3\]"):
        of_cameras(path, [0, 5])


def test_a_rig_stands_left_to_right_as_the_driver_sees_it():
    # 50 degrees to the left, ahead, 50 to the right; 170 to the left is leftmost.
    assert left_to_right(recorded(street_views())[2]) == [3, 1, 0, 2]


def test_a_shifted_rig_moves_as_one_along_the_front_cameras_right():
    path = recorded(street_views())
    for before, after in zip(path, shifted(path, 1.5), strict=True):
        angle = math.radians(3.0 * before[0].indices[0])
        right = torch.tensor([math.sin(angle), -math.cos(angle), 0.0])
        for old, new in zip(before, after, strict=True):
            moved = new.camera.position - old.camera.position
            # Positions of some meters, added up in float32.
            torch.testing.assert_close(moved, 1.5 * right, rtol=0, atol=2e-6)
            assert torch.equal(new.camera.camera_from_world[:3, :3], old.camera.camera_from_world[:3, :3])
            assert (new.time, new.frame_index, new.camera_index) == (old.time, None, old.camera_index)


def test_a_lane_is_changed_smoothly():
    path = recorded(street_views())
    changed = shifted(path, -3.0, gradually=True)
    went = [
        float((new[0].camera.position - old[0].camera.position).norm()) for old, new in zip(path, changed, strict=True)
    ]
    # 3 s^2 - 2 s^3 at s = 0, 1/4, 1/2, 3/4, 1.
    assert went == pytest.approx([0.0, 3 * 5 / 32, 1.5, 3 * 27 / 32, 3.0], abs=2e-6)
    assert float(changed[4][0].camera.camera_from_world[0, 3] - path[4][0].camera.camera_from_world[0, 3]) > 2.9
    assert shifted(path[:1], 3.0, gradually=True)[0][0].camera.position.equal(path[0][0].camera.position)


def test_a_quarter_of_the_way_lies_nearer_to_where_it_begins():
    """1 m and 3 degrees a frame, the same step everywhere."""
    finer = resampled(recorded(street_views()), STEP / 4)
    for index, rig in enumerate(finer):
        way = index / 4
        torch.testing.assert_close(rig[0].camera.position, torch.tensor([way, 0.1 * way, 1.5]), rtol=0, atol=2e-6)
        angle = math.radians(3.0 * way)
        ahead = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
        torch.testing.assert_close(rig[0].camera.camera_from_world[2, :3], ahead, rtol=0, atol=2e-6)


def test_frames_that_are_missing_are_bridged_and_too_many_are_skipped():
    path = recorded([view for view in street_views() if view.frame_index != 2])
    bridged = resampled(path, STEP)
    assert [rig[0].frame_index for rig in bridged] == [0, 1, None, 3, 4]
    torch.testing.assert_close(bridged[2][0].camera.position, torch.tensor([2.0, 0.2, 1.5]), rtol=0, atol=2e-6)
    assert [rig[0].frame_index for rig in resampled(recorded(street_views()), 2 * STEP)] == [0, 2, 4]
    with pytest.raises(ValueError, match="steps above 0"):
        resampled(path, 0.0)


@pytest.mark.parametrize("pieces", [1, 3, 7])
def test_pieces_of_a_step_meet_every_recorded_instant(pieces):
    """Frames of a log of 50: times and steps are no binary fractions, and are met in spite of the rounding."""
    views = [replace(view, time=(40 + view.indices[0]) / 49) for view in street_views()]
    finer = resampled(recorded(views), 1 / 49 / pieces)
    assert [rig[0].frame_index for rig in finer[::pieces]] == [0, 1, 2, 3, 4]
    assert len(finer) == 4 * pieces + 1


def test_another_width_shows_the_same():
    path = recorded(street_views(width=48, height=33))
    view, small = path[1][0], resized(path, 20)[1][0]
    assert (small.camera.width, small.camera.height) == (20, 14)
    points = torch.tensor([[9.0, 1.0, 2.0], [7.0, -3.0, 0.5]])
    pixels, _, _ = project(view.camera, points)
    expected = pixels * torch.tensor([20 / 48, 14 / 33])
    torch.testing.assert_close(project(small.camera, points)[0], expected)
    # Half of 48 pixels is the focal length; each axis has its own factor, 20 / 48 and 14 / 33.
    x, y = 20 / 48, 14 / 33
    expected = torch.tensor([[24 * x, 0, 24 * x], [0, 24 * y, 16.5 * y], [0, 0, 1]])
    torch.testing.assert_close(small.camera.intrinsics, expected)
    assert torch.equal(small.camera.camera_from_world, view.camera.camera_from_world)
    assert small.frame_index == view.frame_index
    with pytest.raises(ValueError, match="at least 1 pixel"):
        resized(path, 0)


def test_at_the_logs_own_rate_the_recorded_instants_are_shown():
    """Whose cameras fire one after the other, so that the last frame's first image is not the end of the log."""
    late = [replace(view, time=(view.indices[0] + 0.2 * view.indices[1]) / 4.6) for view in street_views()]
    path = recorded(late)
    assert resampled(path, 1 / frame_periods(late)) == path
    between = resampled(path, 0.5 / frame_periods(late))
    assert len(between) == 2 * NUM_FRAMES - 1
    assert [view.time for view in between[1]] == pytest.approx([(0.5 + 0.2 * camera) / 4.6 for camera in range(4)])


PATH = recorded(street_views())
POINT = torch.tensor([[9.0, 0.5, 1.0]])


def test_a_raised_rig_sees_from_above():
    for before, after in zip(PATH[2], raised(PATH, 1.25)[2], strict=True):
        offset = after.camera.position - before.camera.position
        torch.testing.assert_close(offset, torch.tensor([0.0, 0.0, 1.25]), rtol=0, atol=2e-6)
        assert torch.equal(after.camera.camera_from_world[:3, :3], before.camera.camera_from_world[:3, :3])
        assert (after.frame_index, after.camera_index, after.time) == (None, before.camera_index, before.time)


@pytest.mark.parametrize("height", [20, 31, 48])
def test_rows_come_and_go_above_and_below(height):
    before, after = PATH[1][0].camera, cropped(PATH, height)[1][0].camera
    assert (after.width, after.height) == (before.width, height)
    (old, _, _), (new, _, _) = project(before, POINT), project(after, POINT)
    # The same distance from the middle row.
    torch.testing.assert_close(new[0, 1] - height / 2, old[0, 1] - before.height / 2)
    assert new[0, 0] == old[0, 0]


def test_a_pinhole_sees_as_far_as_its_field_of_view():
    camera = pinholes(resized(PATH, 60), 100.0)[0][0].camera
    assert (camera.width, camera.height, camera.distortion) == (60, 40, None)
    # Camera 0 looks along +x from (0, 0, 1.5); 50 degrees to the left and to the right are the edges.
    for side, edge in ((1, 0.0), (-1, 60.0)):
        there = torch.tensor([[10.0, side * 10.0 * math.tan(math.radians(50)), 1.5]])
        pixels, _, _ = project(camera, there)
        torch.testing.assert_close(pixels[0], torch.tensor([edge, 20.0]), rtol=0, atol=1e-4)
    with pytest.raises(ValueError, match="more than 0 and less than 180 degrees"):
        pinholes(PATH, 180.0)
