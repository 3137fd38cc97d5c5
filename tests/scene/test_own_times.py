"""Nodes of a log whose boxes, sweeps and images have instants of their own. In frames: f, f + 0.3 and f + 0.4."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.quaternions import slerp
from sparsestreet.scene.body import _filled
from sparsestreet.scene.initialize.gaussians import lidar_in_boxes, outside_boxes
from sparsestreet.scene.nodes import Rigid
from sparsestreet.scene.state import FINISHED
from sparsestreet.types import Track
from tests.scene.nodes.test_field import field_settings
from tests.scene.nodes.test_vibrating import vibrating_settings
from tests.scene.people import walker
from tests.scene.street import (
    CAR_COLOR,
    NUM_FRAMES,
    car_pose,
    pose,
    rigid_settings,
    street_log,
    track,
    training_data,
)  # fmt: skip
from tests.typed import as_a

SWEEP, IMAGE = 0.3, 0.4
LONG = NUM_FRAMES - 1 + IMAGE
"""Frames' worth of time from the first stamp, of a box, to the last, of an image."""
CARS = rigid_settings(points_per_instance=1000, box_points=0)


def timed(track: Track) -> Track:
    frames = track.frames.tolist()
    times = torch.tensor([frame / LONG for frame in frames], dtype=torch.float64)
    return replace(track, times=times, span=(frames[0] / LONG, (frames[-1] + IMAGE) / LONG))


def own_log(*tracks: Track) -> DrivingLog:
    """``street_log``, whose car has driven on when it is measured, and again when its image is taken."""
    log = street_log()
    views = [replace(frame, time=(frame.frame_index + IMAGE) / LONG) for frame in log.frames]
    sweeps = []
    for sweep in log.sweeps:
        later, now = moved_car(sweep.index + SWEEP), car_pose(sweep.index)
        moved = (later @ torch.linalg.inv(now)).float()
        points = sweep.points.clone()
        points[50:-1] = points[50:-1] @ moved[:3, :3].T + moved[:3, 3]
        sweeps.append(replace(sweep, time=(sweep.index + SWEEP) / LONG, points=points))
    tracks = tuple(map(timed, tracks or log.tracks))
    return replace(log, frames=as_frames(views), sweeps=Sweeps.of(tuple(sweeps)), tracks=tracks)


def moved_car(frames: float) -> torch.Tensor:
    """``car_pose`` is linear in the frame."""
    return pose(0.1 * frames, (8.0 + 2.0 * frames, 1.0, 0.75))


def cars(log: DrivingLog, held_out: frozenset[int] = frozenset(), **changes) -> Rigid:
    settings = replace(CARS, **changes)
    node = settings.build(training_data(log, held_out, movers=settings), torch.Generator().manual_seed(0))
    return as_a(Rigid, node)


def test_a_frames_worth_of_time():
    assert own_log().frame_periods == pytest.approx(LONG, abs=1e-12)
    assert street_log().frame_periods == NUM_FRAMES - 1


def test_nodes_without_boxes_count_time_in_frames_too():
    data, generator = training_data(own_log()), torch.Generator().manual_seed(0)
    node = vibrating_settings(lidar=60, near=20).build(data, generator)
    assert node.frame_periods == field_settings(lidar=20, near=10).build(data, generator).frame_periods == LONG
    at = {tuple(place): index + SWEEP for index in range(NUM_FRAMES) for place in data.sweeps[index].points.tolist()}
    measured = [0.02 * at[tuple(place)] for place in node.rows.means[:60].tolist()]
    assert node.rows.life_peaks[:60].tolist() == pytest.approx(measured, rel=1e-5)  # float32
    # At the time of a sweep its returns have all of their opacity.
    rows = [row for row, peak in enumerate(measured) if peak == 0.02 * (1 + SWEEP)]
    opacities = node.gaussians_at(replace(data.views[0], time=data.sweeps[1].time), FINISHED).opacities
    torch.testing.assert_close(opacities[rows], torch.sigmoid(node.rows.opacity_logits[rows]))


@pytest.mark.parametrize("max_gap", [0, 2])
def test_objects_are_where_they_are_when_the_image_is_taken(max_gap: int):
    """In the last frame too, whose image is taken after the last box."""
    log = own_log()
    node = cars(log, max_gap=max_gap)
    for index, view in enumerate(log.views):
        found = node.pose_at(view.time)
        assert found.present.tolist() == [True]
        torch.testing.assert_close(
            found.translations[0], moved_car(index + IMAGE)[:3, 3].float(), atol=1e-5, rtol=0
        )  # float32


def test_the_gap_is_counted_from_the_boxes_of_the_views_frames():
    """Annotated at frames 0 and 4, seen in images of frames 0 to 4."""
    log = own_log(track("car", [0, 4], [car_pose(0), car_pose(4)]))
    node = cars(log, max_gap=1)
    assert [node.pose_at(view.time).present.item() for view in log.views] == [True, True, False, True, True]


def test_returns_lie_in_the_box_of_their_own_time():
    """The car has driven on by 0.6 m and turned by 1.7 degrees since its box was annotated."""
    log = own_log()
    driving = log.tracks[1]
    for sweep in log.sweeps:
        assert int((~outside_boxes([driving], sweep, 1.0)).sum()) == 60
    (found,) = lidar_in_boxes([driving], log.sweeps)
    (expected,) = lidar_in_boxes([street_log().tracks[1]], street_log().sweeps)
    torch.testing.assert_close(found.positions, expected.positions, atol=1e-5, rtol=0)  # float32 of 20 m
    assert found.colors.unique(dim=0).tolist() == torch.tensor([CAR_COLOR]).tolist()


def test_boxes_of_held_out_frames_place_no_return():
    """The third frame's box jumps aside; a sweep of the second lies between the second and the third."""
    poses = [car_pose(frame) for frame in range(NUM_FRAMES)]
    poses[2] = pose(0.0, (12.0, 50.0, 0.75))
    log = own_log(track("driving", list(range(NUM_FRAMES)), poses))
    assert len(cars(log, held_out=frozenset({2})).rows) == 60 * (NUM_FRAMES - 1)
    assert len(cars(log).rows) < 60 * (NUM_FRAMES - 1)


def test_training_times_are_one_a_frame():
    log = own_log()
    second = [replace(frame, camera_index=1, time=frame.time + 0.1 / LONG) for frame in log.frames]
    both = replace(log, frames=as_frames([*second, *log.frames]))
    held_out = frozenset({1})
    assert training_data(both, held_out).times == [frame.time for frame in log.frames if frame.frame_index != 1]


def test_missing_body_poses_are_interpolated_over_time():
    """Poses at the first and last of three boxes, the middle box three times nearer to the first."""
    someone = walker(frames=(0, 1, 2), valid=(True, False, True))
    uneven = replace(someone, times=torch.tensor([0.0, 0.2, 0.8], dtype=torch.float64))
    halfway, quarter = (_filled(each, frozenset()) for each in (someone, uneven))
    ends = halfway[0], halfway[2]
    torch.testing.assert_close(quarter[1], slerp(*ends, torch.full((24,), 0.25)))
    torch.testing.assert_close(halfway[1], slerp(*ends, torch.full((24,), 0.5)))
