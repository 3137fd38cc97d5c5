"""The log that follows from what a reader found: images, sweeps and boxes at instants of their own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import LogError
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedImage, Recording, log_of
from sparsestreet.data.rig import rig_camera
from sparsestreet.geometry.boxes import box_at
from sparsestreet.geometry.trajectories import Trajectories
from tests.data.plan import PER_SECOND, Plan, moved, pose, turned
from tests.typed import there

PLAN = Plan()
AHEAD, LEFT = PLAN.cameras
ON_CAR = np.array([[-1.5, -0.9, 0.5], [0.55, -0.9, -0.3]])
"""On the car's side and rear, which the front camera sees, in its box."""
RED = (250, 10, 20)


def world_from_car(stamps: np.ndarray | int) -> np.ndarray:
    """A car that crosses from the left to the right, 14 m ahead, at 20 m/s: more than a pixel in 25 ms."""
    seconds = (np.asarray(stamps, np.int64) - PLAN.start) / PER_SECOND
    path = np.stack((np.full_like(seconds, 14), 3.5 - 20 * seconds, np.ones_like(seconds)), -1)
    return pose(np.broadcast_to(turned(-np.pi / 2), (*seconds.shape, 3, 3)), path + np.array(PLAN.origin))


def car_points(stamp: int) -> np.ndarray:
    return moved(world_from_car(stamp), ON_CAR)


def pixel_of(frame: int, points: np.ndarray) -> np.ndarray:
    """Columns and rows in the front camera's image, and depths."""
    seen = moved(np.linalg.inv(PLAN.world_from_camera(frame, AHEAD)), points)
    return np.concatenate(
        (seen[:, :2] / seen[:, 2:] @ AHEAD.intrinsics[:2, :2].T + AHEAD.intrinsics[:2, 2], seen[:, 2:]), 1
    )


def image(shot: RecordedImage) -> torch.Tensor:
    """Gray, and red where the points on the car are when the image is taken."""
    pixels = torch.full((AHEAD.height, AHEAD.width, 3), 90, dtype=torch.uint8)
    if shot.camera == 0:
        column, row, _ = pixel_of(shot.frame, car_points(PLAN.image_stamp(shot.frame, AHEAD))).astype(int).T
        inside = (column >= 0) & (column < AHEAD.width)  # all but one of the last frame, which the sweep has just seen
        pixels[row[inside], column[inside]] = torch.tensor(RED, dtype=torch.uint8)
    return pixels


def sweep(frame: int) -> torch.Tensor:
    return torch.from_numpy(np.concatenate((PLAN.world_points(frame), car_points(int(PLAN.stamps[frame])))))


def recording(**changes) -> Recording:
    shots = [
        RecordedImage(
            frame, number, torch.from_numpy(PLAN.world_from_camera(frame, camera)), (frame, number), f"{frame}",
            PLAN.image_stamp(frame, camera),
        )
        for frame in range(PLAN.num_frames)
        for number, camera in enumerate(PLAN.cameras)
    ]  # fmt: skip
    rig = [
        rig_camera(
            camera.name, number, intrinsics=torch.from_numpy(camera.intrinsics), distortion=torch.zeros(5).double(),
            recorded_size=(camera.width, camera.height), width=None,
        )
        for number, camera in enumerate(PLAN.cameras)
    ]  # fmt: skip
    stamps = [int(stamp) for stamp in PLAN.stamps]
    found = Recording(
        name="planned",
        rig=rig,
        shots=shots,
        read_image=image,
        read_masks=lambda shot: {},
        frame_stamps=tuple(stamps),
        sweeps={frame: LidarSweep(lambda frame=frame: sweep(frame)) for frame in range(PLAN.num_frames)},
        boxes=[boxes()],
    )
    return replace(found, **changes)


def boxes(frames: tuple[int, ...] = tuple(range(PLAN.num_frames)), stamps: tuple[int, ...] | None = None) -> Boxes:
    at = PLAN.start + PLAN.period * np.array(frames, np.int64) if stamps is None else np.array(stamps)
    sizes = np.tile(PLAN.box_size, (len(frames), 1))
    return Boxes(PLAN.box_name, "Car", np.array(frames), world_from_car(at), sizes, Path("boxes"), stamps)


def read(**changes) -> DrivingLog:
    return log_of(recording(**changes), cache_bytes=10**6, check=list)


LAST = 3 * PLAN.period + LEFT.delay
"""Nanoseconds from the first stamp, that of the first sweep, to the last, that of the left camera's last image."""


def test_every_view_sweep_and_box_has_the_time_of_its_stamp():
    log = read()
    delays = [camera.delay for camera in PLAN.cameras]
    assert [view.time for view in log.views] == [
        (frame * PLAN.period + delay) / LAST for frame in range(4) for delay in delays
    ]
    frames = [frame * PLAN.period / LAST for frame in range(4)]
    assert [one.time for one in log.sweeps] == frames
    (track,) = log.tracks
    assert (there(track.times).tolist(), track.span) == (frames, (0.0, 1.0))
    assert log.frame_periods == pytest.approx(LAST / PLAN.period, abs=1e-12)


def test_an_object_is_there_in_every_image_of_its_frames():
    """The images are taken behind the stamps of the boxes."""
    (track,) = read(boxes=[boxes((1, 2))]).tracks
    assert track.span == (PLAN.period / LAST, (2 * PLAN.period + LEFT.delay) / LAST)
    keyframes = Trajectories.from_tracks([track], frozenset(), PLAN.num_frames)
    torch.testing.assert_close(keyframes.spans[0], torch.tensor(there(track.span)), atol=1e-7, rtol=0)  # float32
    torch.testing.assert_close(keyframes.times[0], there(track.times).float())


def test_boxes_are_where_the_car_is_when_an_image_is_taken():
    log = read()
    origin = log.dataset_from_world[:3, 3]
    for view in log.views:
        found = there(box_at(log.tracks[0], view.indices[0], view.time))
        truth = torch.from_numpy(world_from_car(there(view.stamp)))
        assert float((found[:3, 3] + origin - truth[:3, 3]).abs().max()) < 1e-9  # of 4 km
        assert float((found[:3, :3] - truth[:3, :3]).abs().max()) < 1e-12


def test_returns_of_a_moving_car_have_depth_and_color_where_the_image_shows_them():
    log = read()
    for frame in range(3):
        stamp = PLAN.image_stamp(frame, AHEAD)
        column, row, depth = pixel_of(frame, car_points(stamp)).T
        found = there(log.frames[2 * frame].depth)[row.astype(int), column.astype(int)]
        assert np.abs(found.numpy() - depth).max() < 1e-4  # float32 of 14 m, and the rounding of the pose
        seen = log.sweeps[frame]
        assert (255 * seen.colors[-len(ON_CAR) :]).round().int().tolist() == [list(RED)] * len(ON_CAR)
        assert torch.equal(seen.points, (sweep(frame) - log.dataset_from_world[:3, 3]).float())
    for gray, seen in zip(log.sweeps.gray(), log.sweeps, strict=True):
        assert torch.equal(gray.colored, seen.colored)


@pytest.mark.parametrize("cameras", [(), (LEFT.name,)], ids=["instants", "a camera too"])
def test_no_training_view_depends_on_a_held_out_box(cameras: tuple[str, ...]):
    """The image of frame 1 is taken on the way to the box of frame 2, which is held out."""
    right, wrong = boxes(), boxes()
    wrong.poses[2, 0, 3] += 2.0
    logs = [StreetData(read(boxes=[each]), stride=4, offset=2, cameras=cameras) for each in (right, wrong)]
    assert logs[0].split.held_out_indices == {2}
    for part in ("train", "held_out"):
        first, second = (getattr(data.split, part) for data in logs)
        for one, other in zip(first, second, strict=True):
            # A held-out view shows whatever its own box carries.
            own = one.indices == (2, 0)
            assert torch.equal(there(one.depth), there(other.depth)) == (not own)
    for one, other in zip(logs[0].driving_log.sweeps, logs[1].driving_log.sweeps, strict=True):
        if one.index != 2:
            assert torch.equal(one.colors, other.colors)
            assert torch.equal(one.colored, other.colored)
        if one.index < 2:  # the last image does not show all of the car
            assert (255 * one.colors[-len(ON_CAR) :]).round().int().tolist() == [list(RED)] * len(ON_CAR)


def test_without_boxes_returns_stay_where_they_were_measured():
    """They take the color of what is beside the car."""
    seen = read(boxes=None).sweeps[0]
    assert (255 * seen.colors[-len(ON_CAR) :]).round().int().tolist() == [[90] * 3] * len(ON_CAR)


def test_boxes_and_sweeps_may_have_stamps_of_their_own():
    late = tuple(int(stamp) + 40_000_000 for stamp in PLAN.stamps)
    sweeps = {frame: LidarSweep(lambda frame=frame: sweep(frame), late[frame]) for frame in range(PLAN.num_frames)}
    log = read(boxes=[boxes(stamps=late)], sweeps=sweeps)
    wanted = [(stamp - PLAN.start) / LAST for stamp in late]
    assert there(log.tracks[0].times).tolist() == [one.time for one in log.sweeps] == wanted
    assert [one.stamp for one in log.sweeps] == list(late)


def test_stamps_before_the_first_frame_count_too():
    early = tuple(int(stamp) - 30_000_000 for stamp in PLAN.stamps)
    log = read(boxes=[boxes(stamps=early)])
    assert there(log.tracks[0].times)[0] == 0.0
    assert log.sweeps[0].time == 30_000_000 / (LAST + 30_000_000)
    sweeps = {1: LidarSweep(lambda: sweep(1), early[0])}
    assert read(sweeps=sweeps).sweeps[1].time == 0.0
    shots = [replace(shot, stamp=PLAN.start - 50_000_000 + shot.frame) for shot in recording().shots]
    log = read(shots=shots)
    assert (log.views[0].time, log.views[0].seconds, log.tracks[0].span) == (0.0, -0.05, (0.0, 1.0))


def test_boxes_outside_of_the_window_are_dropped_with_their_stamps():
    frames = (-2, -1, 1, 3, 4, 9)
    stamps = tuple(PLAN.start + PLAN.period * frame for frame in frames)
    (track,) = read(boxes=[boxes(frames, stamps), replace(boxes((-1, 7)), name="elsewhere")]).tracks
    assert track.frames.tolist() == [1, 3]
    assert there(track.times).tolist() == [PLAN.period / LAST, 3 * PLAN.period / LAST]


@pytest.mark.parametrize("stamps", [(1, 2, 3), (1, 2, 2, 3)])
def test_stamps_of_boxes_that_cannot_be(stamps: tuple[int, ...]):
    broken = replace(boxes(), stamps=stamps)
    with pytest.raises(LogError, match=r"car-1 has 4 boxes, and . stamps or some out of order"):
        read(boxes=[broken])


def test_without_a_clock_all_of_a_frame_has_the_frames_time():
    shots = [replace(shot, stamp=None) for shot in recording().shots]
    log = read(frame_stamps=None, shots=shots)
    assert [view.time for view in log.views] == [frame / 3 for frame in range(4) for _ in range(2)]
    assert [one.time for one in log.sweeps] == [0.0, 1 / 3, 2 / 3, 1.0]
    assert (log.tracks[0].times, log.tracks[0].span, log.frame_periods) == (None, None, 3.0)
