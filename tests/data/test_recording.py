"""The log that follows from what a reader found: here, of a camera whose lens is taken out of its images."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.log_warnings import log_warnings
from sparsestreet.data.poses import PosePath
from sparsestreet.data.problems import LogError, fault
from sparsestreet.data.recorded_images import RecordedImage
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedReader, Recording, ahead_only, log_of
from sparsestreet.data.rig import RigCamera, lens_camera, rig_camera
from sparsestreet.geometry.boxes import box_at
from sparsestreet.geometry.lenses import Fisheye, Lens, Rational
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.types import Shutter
from tests.data.plan import PER_SECOND, Plan, moved, pose, turned
from tests.typed import there

SIZE = (24, 16)
WIDE = Fisheye(fx=8.0, fy=8.0, cx=12.0, cy=8.0, k1=-0.02)
FLAT = Rational(fx=30.0, fy=30.0, cx=12.0, cy=8.0)
HOOD = torch.zeros(16, 24, dtype=torch.bool)
HOOD[13:] = True


def camera(lens: Lens) -> RigCamera[str]:
    return lens_camera("front", 0, lens=lens, recorded_size=SIZE, pinhole_fov=None if lens is FLAT else 150.0)


ORIGIN = torch.eye(4, dtype=torch.float64)
FAR = torch.eye(4, dtype=torch.float64)
FAR[:3, 3] = torch.tensor([4e6, -2e6, 100.0])


def log_with(*stamps: int | None, lens: Lens = FLAT, at: torch.Tensor = ORIGIN, **parts) -> DrivingLog:
    """Black images of one camera at a place, each with its stamp, and parts of a recording."""
    shots = [RecordedImage(frame, 0, at, None, "", stamp) for frame, stamp in enumerate(stamps or [None])]
    black = torch.zeros(SIZE[1], SIZE[0], 3, dtype=torch.uint8)
    found = Recording("a", [camera(lens)], shots, lambda shot: black, lambda shot: {})
    return log_of(replace(found, **parts), cache_bytes=0, check=list)


@pytest.mark.parametrize("user", [{}, {"ego": HOOD}], ids=["no mask", "a hood"])
@pytest.mark.parametrize("lens", [WIDE, FLAT], ids=["fisheye", "pinhole"])
def test_no_loss_sees_what_the_lens_did_not_record(lens, user):
    log = log_with(lens=lens, read_masks=lambda shot: user)
    ego = log.frames[0].ego
    if lens is FLAT:
        assert ego is user.get("ego")
        assert "resampled" not in " ".join(log.notes)
    else:
        blank = there(there(camera(lens).undistortion).blank)
        assert 0 < int(blank.sum()) < blank.numel()
        assert torch.equal(there(ego), blank | HOOD if user else blank)
        assert any("resampled to a pinhole of 150 degrees" in note for note in log.notes)
    assert user in ({}, {"ego": HOOD})  # what a reader keeps is not changed


def test_points_that_came_with_the_log_are_in_its_world_and_give_no_depth():
    ahead, reads = FAR[:3, 3] + torch.tensor([[0.0, 0.25, 5.0]], dtype=torch.float64), []
    colors = torch.tensor([[0.25, 0.5, 0.75]])
    log = log_with(at=FAR, sparse_points=lambda: reads.append(1) or (ahead, colors))
    assert not reads  # nothing is decoded when a log is opened
    sparse = there(log.sparse_points)
    assert sparse().positions.tolist() == [[0.0, 0.25, 5.0]]
    assert sparse().colors.tolist() == [[0.25, 0.5, 0.75]]
    assert len(reads) == 1
    assert log.frames[0].depth is None
    assert not len(log.sweeps)


@pytest.mark.parametrize("broken", [math.nan, math.inf, -1e39])
def test_points_that_are_not_finite_are_left_out_and_gray_ones_are_told(broken):
    """-1e39 m is finite in the file, and not in float32."""
    places = torch.tensor([[0.0, 1.0, 5.0]] * 5, dtype=torch.float64)
    places[3, 1], places[4, 2] = broken, math.nan
    log = log_with(sparse_points=lambda: (places, torch.full((5, 3), 0.5)), points_file=Path("cloud.ply"))
    assert there(log.sparse_points)().positions.tolist() == [[0.0, 1.0, 5.0]] * 3
    lost, gray = log_warnings(replace(log, frames=log.frames[:0]))
    assert lost == "2 of 5 points of cloud.ply are not finite, the first is point 3: left out"
    assert gray.startswith("the points of cloud.ply have no colors that are known")


def test_points_far_from_the_origin_keep_their_millimeters():
    ahead = torch.tensor([[0.123, 0.456, 5.789]], dtype=torch.float64)
    points = log_with(at=FAR, sweeps={0: LidarSweep(lambda: FAR[:3, 3] + ahead)}).sweeps[0].points
    torch.testing.assert_close(points.double(), ahead, rtol=0, atol=1e-6)  # float32 of 6 m


def test_the_recording_car_has_no_returns():
    points = torch.tensor([[0.0, 0.5, 5.0], [0.0, 1.3, 5.0]], dtype=torch.float64)  # rows 11 and 15.8
    log = log_with(read_masks=lambda shot: {"ego": HOOD}, sweeps={0: LidarSweep(lambda: points)})
    assert there(log.frames[0].depth).nonzero().tolist() == [[11, 12]]
    assert log.sweeps[0].colored.tolist() == [True, False]


def test_a_declared_shutter_arrives_at_the_view():
    rolling = Shutter(torch.tensor([0.0, 0.0, 0.4]), torch.zeros(3), direction="left")
    shots = [
        RecordedImage(frame, 0, ORIGIN, key=None, stem="", shutter=shutter)
        for frame, shutter in enumerate((rolling, None))
    ]
    log = log_with(shots=shots)
    assert [view.camera.shutter for view in log.views] == [rolling, None]


def moving(frames: list[int], stamps: list[int]) -> Boxes:
    """1 m along x for each 10 ns, turning about z by 0.01 rad for each."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, 0, 3] = np.array(stamps) / 10
    poses[:, :3, :3] = Rotation.from_rotvec([[0, 0, 0.01 * stamp] for stamp in stamps]).as_matrix()
    return Boxes("car", "Car", np.array(frames), poses, np.ones((len(frames), 3)), Path("boxes"), tuple(stamps))


def test_boxes_of_one_object_that_differ_in_size_are_told():
    """One grows in length; the other is measured to a few centimeters."""
    grown, measured = moving([0, 1, 2], [100, 110, 125]), replace(moving([0, 2], [100, 125]), name="van")
    grown.sizes[2, 0], measured.sizes[1, 2] = 3.0, 1.09
    log = log_with(100, 101, 102, frame_stamps=(100, 101, 102), boxes=[grown, measured])
    said = [note for note in log.notes if "differ" in note]
    assert said == ["the boxes of some objects differ in size, their mean is taken: car, length 1.00 to 3.00 m"]


@pytest.mark.parametrize(
    ("frames", "annotated", "there"),
    [
        ([0, 4], {0, 4}, [0, 1, 2, 3, 4]),
        ([0, 4], {0, 2, 4}, [0, 4]),  # seen to be absent at 2
        ([0, 2], {0, 2, 4}, [0, 1, 2]),
        ([-2, 2], {-2, 2, 6}, [0, 1, 2]),
        ([2, 6], {-2, 2, 6}, [2, 3, 4]),
        ([0, 4], None, [0, 4]),
    ],
)
def test_an_object_is_on_its_way_between_annotated_instants(
    frames: list[int], annotated: set[int] | None, there: list[int]
):
    stamps = (100, 110, 125, 130, 140)  # images do not come evenly
    own = {-2: 80, 0: 100, 2: 121, 4: 141, 6: 160}  # nor are boxes where images are
    boxes = moving(frames, [own[frame] for frame in frames])
    instants = None if annotated is None else frozenset(annotated)
    (track,) = log_with(*stamps, frame_stamps=stamps, boxes=[boxes], annotated=instants).tracks
    assert track.frames.tolist() == there
    at = [own[frame] if frame in frames else stamps[frame] for frame in there]
    assert track.world_from_object[:, 0, 3].tolist() == pytest.approx([stamp / 10 for stamp in at], abs=1e-9)
    turned = Rotation.from_matrix(track.world_from_object[:, :3, :3].numpy()).as_rotvec()[:, 2]
    assert turned == pytest.approx([0.01 * stamp for stamp in at], abs=1e-9)


def test_a_box_between_two_has_the_size_of_the_one_before():
    """The two boxes between the three that are annotated; the size of the object is the mean of all."""
    boxes, stamps = moving([0, 2, 4], [100, 121, 141]), (100, 110, 121, 130, 141)
    boxes.sizes[:, 0] = 1.0, 1.05, 1.09
    (track,) = log_with(*stamps, frame_stamps=stamps, boxes=[boxes], annotated=frozenset({0, 2, 4})).tracks
    assert track.size.tolist() == pytest.approx([(1.0 + 1.0 + 1.05 + 1.05 + 1.09) / 5, 1.0, 1.0], abs=1e-6)


class Broken(RecordedReader):
    """One image, one mask and one sweep, of which none can be read."""

    def recording(self) -> Recording:
        where = Path(self.root)

        def broken(what: str) -> NoReturn:
            raise fault(where / what, "it is broken", "write it again")

        shot = RecordedImage(0, 0, torch.eye(4, dtype=torch.float64), where / "image.png", "image")
        return Recording(
            "a", [camera(FLAT)], [shot], lambda shot: broken("image.png"), lambda shot: broken("mask.png"),
            mask_kinds={"sky": "shipped"}, sweeps={0: LidarSweep(lambda: broken("sweep.bin"))},
        )  # fmt: skip


def test_a_check_reads_images_masks_and_sweeps(tmp_path: Path):
    (tmp_path / "image.png").write_bytes(b"no image")
    found = {problem.path.name for problem in Broken(root=tmp_path).check_contents()}
    assert found == {"image.png", "mask.png", "sweep.bin"}


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


def test_returns_ahead_of_the_vehicle():
    """By the car's own place at each sweep; a log that knows no vehicle says that nothing is cut."""
    stamps = [int(stamp) for stamp in PLAN.stamps]
    path = PosePath(torch.tensor(stamps), torch.from_numpy(PLAN.world_from_vehicle(PLAN.stamps)))
    cut, everything = ahead_only(recording(vehicle=path), (-3.0, 11)), recording()
    kept = []
    for frame in range(PLAN.num_frames):
        points = there(everything.sweeps)[frame].read().numpy()
        x = moved(np.linalg.inv(PLAN.world_from_vehicle(stamps[frame])), points)[:, 0]
        expected = points[(x > -3) & (x < 11)]
        np.testing.assert_array_equal(there(cut.sweeps)[frame].read().numpy(), expected)
        kept.append(len(expected) / len(points))
    assert 0 < min(kept) <= max(kept) < 0.8
    # Sweeps of their own instants, one of them before the first pose: the vehicle is where it is known next.
    moments = {frame: stamp + 30_000_000 * (frame - 1) for frame, stamp in enumerate(stamps)}
    timed = recording(
        vehicle=replace(path, stamps=path.stamps[1:], poses=path.poses[1:]),
        sweeps={
            frame: LidarSweep(partial(sweep, frame), stamp, intensities=lambda frame=frame: sweep(frame)[:, 0].float())
            for frame, stamp in moments.items()
        },
    )
    for frame, stamp in moments.items():
        nearest = torch.tensor([stamp]).clamp(stamps[1], stamps[-1])
        x = moved(np.linalg.inv(path.at(nearest)[0].numpy()), sweep(frame).numpy())[:, 0]
        cut = there(ahead_only(timed, (-3.0, 11)).sweeps)[frame]
        found = cut.read()
        assert torch.equal(there(cut.intensities)(), found[:, 0].float())
        assert torch.equal(found, sweep(frame)[torch.from_numpy((x > -3) & (x < 11))])
    for parts, why in (({}, "the log does not tell where its vehicle was"), ({"sweeps": None}, "no lidar is read")):
        assert ahead_only(recording(**parts), (-2, 80)).notes == (f"lidar_ahead=[-2, 80] has no effect: {why}",)


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
