"""A log comes off the disk with the geometry, pixels and boxes that were put there."""

import json
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import ImageFile

from sparsestreet.data.drivestudio import DriveStudioReader, contents
from sparsestreet.data.log import split
from sparsestreet.geometry.cameras import project
from sparsestreet.types import Frame, Sweep
from tests.data.drivestudio.folders import (
    CAR,
    CAR_SIZE,
    COLORS,
    FIRST_STAMP,
    FOCAL,
    HEIGHT,
    POINTS_IN_WORLD,
    STEP,
    WIDTH,
    make_mounted_opencv,
    make_nuscenes,
    make_waymo,
    pose,
    write_image,
    write_json,
    write_lines,
    write_stamps,
)
from tests.typed import there

MAP = np.array([450123.377, 5400321.713, 230.19])  # meters, as UTM coordinates of central Europe
FLAVORS = pytest.mark.parametrize("make", [make_nuscenes, make_waymo])


@FLAVORS
def test_frames_are_ordered_and_timed(make, tmp_path):
    log = DriveStudioReader(make(tmp_path / "street_7")).read()
    assert (log.name, log.num_frames, log.num_cameras, log.notes) == ("street_7", 3, 2, ())
    assert [(frame.frame_index, frame.camera_index) for frame in log.frames] == [
        (i, c) for i in range(3) for c in range(2)
    ]
    assert [frame.time for frame in log.frames[::2]] == [0.0, 0.5, 1.0]
    assert [sweep.index for sweep in log.sweeps] == [0, 1, 2]
    assert log.frames[0].image.dtype == torch.uint8
    assert (log.frames[0].camera.width, log.frames[0].camera.height) == (WIDTH, HEIGHT)


@FLAVORS
def test_frames_and_sweeps_have_the_stamps_of_the_folder(make, tmp_path):
    """A clock that is not even: 10 frames a second on the whole."""
    stamps = [FIRST_STAMP, FIRST_STAMP + 70_000_000, FIRST_STAMP + 200_000_000]
    write_stamps(make(tmp_path), stamps)
    log = DriveStudioReader(tmp_path).read()
    assert [frame.stamp for frame in log.frames] == [stamp for stamp in stamps for _ in range(2)]
    assert [frame.seconds for frame in log.frames[::2]] == [0.0, 0.07, 0.2]
    assert [frame.time for frame in log.frames[::2]] == [0.0, 0.35, 1.0]
    assert [sweep.time for sweep in log.sweeps] == log.tracks[0].times.tolist() == [0.0, 0.35, 1.0]
    for sweeps in (log.sweeps, log.sweeps.gray()):
        assert [(sweep.seconds, sweep.stamp) for sweep in sweeps] == list(zip([0.0, 0.07, 0.2], stamps, strict=True))
    assert (log.frame_rate, list(log.stamps.values())) == (10.0, stamps)


def test_the_clock_of_a_window_starts_at_its_first_frame(tmp_path):
    make_nuscenes(tmp_path, frames=6)
    log = DriveStudioReader(tmp_path, first_frame=2, last_frame=4).read()
    assert log.stamps == {0: FIRST_STAMP + 2 * STEP, 1: FIRST_STAMP + 3 * STEP, 2: FIRST_STAMP + 4 * STEP}
    assert log.seconds == {0: 0.0, 1: 0.1, 2: 0.2}
    assert log.frame_rate == 10.0
    alone = DriveStudioReader(tmp_path, last_frame=0).read()
    assert (alone.frame_rate, alone.frames[0].time) == (None, 0.0)


@FLAVORS
def test_a_point_straight_ahead_lands_in_the_image_center(make, tmp_path):
    """Camera 0 stands at height 1.5 m and looks along the drive: (x, 0, 1.5) is on its axis, at depth x - frame."""
    log = DriveStudioReader(make(tmp_path)).read()
    for frame in log.frames[::2]:
        pixels, depths, inside = project(frame.camera, log.sweeps[frame.frame_index].points[:2])
        assert inside.all()
        assert torch.allclose(pixels, torch.tensor([WIDTH / 2, HEIGHT / 2]), atol=1e-4)  # float32 of a 40 px image
        assert torch.allclose(depths, torch.tensor([10.0, 20.0]) - frame.frame_index, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "stood"),
    [(make_nuscenes, (0.0, 0.0, 1.8)), (make_waymo, (1.4, 0.0, 2.2)), (make_mounted_opencv, None)],
    ids=["nuscenes", "waymo", "kitti"],
)
def test_where_the_lidar_stood_is_told_by_its_pose_or_by_its_rays(make, stood, tmp_path):
    """The world of nuScenes begins at the first camera, 1.5 m above the ground; that of Waymo drives along y."""
    log = DriveStudioReader(make(tmp_path)).read()
    for sweep in log.sweeps:
        if stood is None:
            assert sweep.origin is None
            continue
        ahead, left, up = stood
        wanted = (ahead + sweep.index, left, up - 1.5) if make is make_nuscenes else (-left, ahead + sweep.index, up)
        assert there(sweep.origin).tolist() == pytest.approx(wanted, abs=1e-6)  # float32 rows


@FLAVORS
def test_left_and_up_are_left_and_up_in_the_image(make, tmp_path):
    """The point at (8, 0.3, 1.5) is left of camera 0 by 0.3 m at 8 m; the car's center is left and below."""
    log = DriveStudioReader(make(tmp_path)).read()
    pixels, _, inside = project(log.frames[0].camera, log.sweeps[0].points[[2, 4]])
    expected = torch.tensor(
        [
            [WIDTH / 2 - FOCAL * 0.3 / 8, HEIGHT / 2],
            [WIDTH / 2 - FOCAL * CAR[1] / CAR[0], HEIGHT / 2 + FOCAL * (1.5 - CAR[2]) / CAR[0]],
        ]
    )
    assert inside.all()
    assert torch.allclose(pixels, expected.float(), atol=1e-4)


@FLAVORS
def test_map_coordinates_keep_their_relative_geometry(make, tmp_path):
    """float32 at 5.4e6 has a spacing of 0.5 m; after re-centering in float64 nothing of that may be left."""
    here = DriveStudioReader(make(tmp_path / "here")).read()
    far = DriveStudioReader(make(tmp_path / "far", offset=MAP)).read()
    for frame, distant in zip(here.frames, far.frames, strict=True):
        assert torch.allclose(frame.camera.camera_from_world, distant.camera.camera_from_world, atol=1e-4)
    for sweep, distant in zip(here.sweeps, far.sweeps, strict=True):
        assert torch.allclose(sweep.points, distant.points, atol=1e-4)
    assert torch.allclose(here.tracks[0].world_from_object, far.tracks[0].world_from_object, atol=1e-4)
    in_dataset = far.dataset_from_world @ far.tracks[0].world_from_object[1]
    # 1e-8 m: float64 at 5.4e6 m has a spacing of 1e-9.
    assert torch.allclose(in_dataset, torch.from_numpy(pose(np.eye(3), CAR + MAP)), rtol=0, atol=1e-8)
    assert far.frames[0].camera.position.norm() < 2


def test_the_world_starts_at_the_front_camera_whichever_cameras_are_read(tmp_path):
    """nuScenes flavor: camera 0 at the first frame is the origin, so camera 1 alone stands 0.5 m to its left."""
    log = DriveStudioReader(make_nuscenes(tmp_path), cameras=[1], first_frame=1).read()
    assert torch.allclose(log.frames[0].camera.position, torch.tensor([0, 0.5, 0]), atol=1e-6)


def test_the_waymo_world_starts_at_the_vehicle(tmp_path):
    """World axes stay the data set's: the vehicle drives along world y, and its cameras ride 1.5 m above."""
    log = DriveStudioReader(make_waymo(tmp_path, offset=MAP)).read()
    positions = torch.stack([frame.camera.position for frame in log.frames[::2]])
    assert torch.allclose(positions, torch.tensor([[0.0, 0, 1.5], [0, 1, 1.5], [0, 2, 1.5]]), atol=1e-5)


def test_the_vehicle_is_known_where_cameras_are_mounted_on_it(tmp_path):
    vehicle = there(DriveStudioReader(make_waymo(tmp_path / "waymo", offset=MAP), first_frame=1).read().vehicle)
    assert vehicle.stamps is None  # those of the frames
    assert vehicle.poses[:, :3, 3].tolist() == [[0, 0, 0], [0, 1, 0]]
    assert vehicle.poses[0, :3, 0].tolist() == [0, 1, 0]  # ahead
    assert DriveStudioReader(make_nuscenes(tmp_path / "nuscenes")).read().vehicle is None


def test_the_window_and_the_cameras_are_counted_from_zero(tmp_path):
    whole = DriveStudioReader(make_nuscenes(tmp_path, frames=6)).read()
    part = DriveStudioReader(tmp_path, first_frame=2, last_frame=4, cameras=[1, 0]).read()
    assert (part.num_frames, part.num_cameras) == (3, 2)
    assert [(frame.frame_index, frame.camera_index) for frame in part.frames[:3]] == [(0, 0), (0, 1), (1, 0)]
    assert torch.equal(part.frames[0].image, whole.frames[5].image)  # frame 2 of camera 1 comes first
    assert torch.equal(part.tracks[0].frames, torch.arange(3))
    assert part.frames[-1].time == 1.0


def test_tracks_outside_the_window_are_dropped_and_gaps_are_kept(tmp_path):
    make_nuscenes(tmp_path, frames=6)
    path = tmp_path / "instances/instances_info.json"
    car = json.loads(path.read_text())["0"]
    annotations = {name: [values[0], values[3]] for name, values in car["frame_annotations"].items()}
    annotations |= {"frame_idx": [1, 4], "box_size": [CAR_SIZE, [size + 1 for size in CAR_SIZE]]}
    gap = car | {"frame_annotations": annotations}
    write_json(path, {"0": car, "9": gap})
    write_json(tmp_path / "instances/frame_instances.json", {"1": [0, 9]})  # frames without objects have no key
    log = DriveStudioReader(tmp_path).read()
    assert [(track.name, track.class_name) for track in log.tracks] == [("0", "Vehicle"), ("9", "Vehicle")]
    assert log.tracks[1].frames.tolist() == [1, 4]
    assert log.tracks[1].world_from_object.shape == (2, 4, 4)
    assert torch.allclose(log.tracks[1].size, torch.tensor(CAR_SIZE) + 0.5)  # the mean of both boxes
    assert [track.name for track in DriveStudioReader(tmp_path, first_frame=2, last_frame=3).read().tracks] == ["0"]


def test_width_scales_images_masks_and_intrinsics_per_axis(tmp_path):
    log = DriveStudioReader(make_nuscenes(tmp_path), width=15).read()
    frame = log.frames[0]
    assert frame.image.shape == (9, 15, 3)  # 24 * 15 / 40
    assert frame.sky.shape == frame.vehicle.shape == frame.depth.shape == (9, 15)
    k = frame.camera.intrinsics
    assert torch.allclose(k, torch.tensor([[15.0, 0, 7.5], [0, 15, 4.5], [0, 0, 1]]), atol=1e-6)
    k = DriveStudioReader(tmp_path, width=21).read().frames[0].camera.intrinsics  # 12.6 rows become 13
    assert torch.allclose(torch.diagonal(k), torch.tensor([21.0, 40 * 13 / 24, 1]), atol=1e-5)
    with pytest.raises(ValueError, match="1 to 40"):
        DriveStudioReader(tmp_path, width=41).read()


def test_masks_are_where_they_were_drawn(tmp_path):
    frame = DriveStudioReader(make_nuscenes(tmp_path)).read().frames[0]
    rows = torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH)
    assert torch.equal(frame.sky, rows < HEIGHT // 4)
    assert torch.equal(frame.vehicle, rows >= HEIGHT - HEIGHT // 4)
    assert torch.equal(frame.human, rows < HEIGHT // 4)


def test_shrunken_object_masks_keep_every_pixel_they_touch_and_sky_does_not_grow(tmp_path):
    """A quarter of the size: the nearest pixel of (i, j) is (4 i + 2, 4 j + 2), and a line beside it goes unseen."""
    make_nuscenes(tmp_path)
    lines = np.zeros((HEIGHT, WIDTH), np.uint8)
    lines[:, 9] = 255
    lines[18, :] = 255
    for folder in ("sky_masks", "dynamic_masks/vehicle", "dynamic_masks/human"):
        write_image(tmp_path / folder / "000_0.png", lines)
    frame = DriveStudioReader(tmp_path, width=10).read().frames[0]
    for mask in (frame.vehicle, frame.human):
        assert mask[:, 2].all()
        assert mask[4].all()
    expected = torch.zeros(6, 10, dtype=torch.bool)
    expected[4] = True
    assert torch.equal(frame.sky, expected)


def test_a_mask_of_the_recording_car_holds_for_all_images_of_its_camera(tmp_path):
    make_nuscenes(tmp_path)
    hood = np.zeros((HEIGHT, WIDTH), np.uint8)
    hood[HEIGHT // 2 :] = 255
    write_image(tmp_path / "ego_masks/1.png", hood)
    log = DriveStudioReader(tmp_path).read()
    for frame in log.frames:
        if frame.camera_index == 0:
            assert frame.ego is None
        else:
            assert torch.equal(frame.ego, torch.from_numpy(hood > 0))
    (turned,) = {
        frame.camera_index
        for frame in DriveStudioReader(tmp_path, cameras=[1, 0]).read().frames
        if frame.ego is not None
    }
    assert turned == 0  # the folder's camera 1 is the log's first
    assert DriveStudioReader(tmp_path, width=10).read().frames[1].ego.shape == (6, 10)


def test_fine_masks_replace_the_coarse_ones(tmp_path):
    make_nuscenes(tmp_path)
    assert DriveStudioReader(tmp_path).read().masks == {"sky": "shipped", "human": "coarse", "vehicle": "coarse"}
    for kind in ("human", "vehicle"):
        shutil.copytree(tmp_path / "dynamic_masks" / kind, tmp_path / "fine_dynamic_masks" / kind)
    write_image(tmp_path / "fine_dynamic_masks/vehicle/000_0.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    log = DriveStudioReader(tmp_path).read()
    assert log.frames[0].vehicle.all()
    assert not log.frames[1].vehicle.all()
    assert log.masks == {"sky": "shipped", "human": "fine", "vehicle": "fine"}


@pytest.mark.parametrize(
    ("folder", "word"),
    [("sky_masks", "sky"), ("lidar", "lidar"), ("instances", "boxes"), ("dynamic_masks/human", "human")],
)
@FLAVORS
def test_what_is_optional_may_be_absent_and_is_noted(make, folder, word, tmp_path):
    shutil.rmtree(make(tmp_path) / folder)
    log = DriveStudioReader(tmp_path).read()
    assert len(log.notes) == 1
    assert word in log.notes[0]
    assert word not in (log.masks or {})
    absent = {"sky_masks": log.frames[0].sky, "lidar": log.frames[0].depth, "dynamic_masks/human": log.frames[0].human}
    assert absent.get(folder) is None
    assert len(log.sweeps) == (0 if folder == "lidar" else 3)
    assert log.tracks == () if folder == "instances" else len(log.tracks) == 1


@FLAVORS
def test_lidar_that_is_not_wanted_is_as_good_as_absent_and_need_not_be_sound(make, tmp_path):
    make(tmp_path / "log")
    (tmp_path / "log/lidar/000.bin").write_bytes(b"half")
    (tmp_path / "log/lidar/001.bin").unlink()
    (tmp_path / "log/lidar/007.bin").write_bytes(b"")  # longer than the images
    shutil.rmtree(tmp_path / "log/lidar_pose", ignore_errors=True)
    if make is make_nuscenes:
        write_lines(tmp_path / "log/lidar_pose/008.txt", [0.0])
    reader = DriveStudioReader(tmp_path / "log", lidar=False)
    assert reader.check() == []
    log = reader.read()
    assert len(log.sweeps) == 0
    assert all(frame.depth is None for frame in log.frames)
    for folder in ("lidar", "lidar_pose"):
        shutil.rmtree(tmp_path / "log" / folder, ignore_errors=True)
    bare = DriveStudioReader(tmp_path / "log").read()
    assert (log.num_frames, log.notes) == (bare.num_frames, bare.notes) == (3, log.notes)
    assert "no lidar" in log.notes[0]


def test_an_empty_sweep_is_a_sweep(tmp_path):
    (make_nuscenes(tmp_path) / "lidar/001.bin").write_bytes(b"")
    log = DriveStudioReader(tmp_path).read()
    assert log.sweeps[1].points.shape == (0, 3)
    assert not log.frames[2].depth.any()


@FLAVORS
def test_sweeps_and_images_of_an_instant_give_each_other_color_and_depth(make, tmp_path):
    """At frame 0 all points but the one behind the vehicle lie in camera 0's (red) image; JPEG costs a few levels.
    Points 0 and 1 share the center pixel, at 10 and 20 m."""
    log = DriveStudioReader(make(tmp_path)).read()
    sweep, depth = log.sweeps[0], there(log.frames[0].depth)
    assert depth[HEIGHT // 2, WIDTH // 2] == pytest.approx(10.0, abs=1e-5)
    assert int((depth > 0).sum()) == 3
    assert sweep.colored.tolist() == [True, True, True, False, True]
    red = torch.tensor(COLORS[0]) / 255
    assert torch.allclose(sweep.colors[sweep.colored], red.expand(4, 3), atol=4 / 255)
    assert torch.equal(sweep.colors[3], torch.full((3,), 0.5))
    assert sweep.points.shape == POINTS_IN_WORLD.shape


def test_images_may_have_stamps_of_their_own(tmp_path):
    """The second camera fires 30 ms after the frames, and 20 before the last."""
    make_nuscenes(tmp_path)
    own = [FIRST_STAMP + 30_000_000, FIRST_STAMP + STEP + 30_000_000, FIRST_STAMP + 2 * STEP - 20_000_000]
    before = DriveStudioReader(tmp_path).data_hash()
    write_stamps(tmp_path, own, "timestamps_1.txt")
    assert DriveStudioReader(tmp_path).check() == []
    assert DriveStudioReader(tmp_path).data_hash() != before
    log = DriveStudioReader(tmp_path).read()
    assert [view.stamp for view in log.views[1::2]] == own
    assert [view.time for view in log.views] == [0.0, 0.15, 0.5, 0.65, 1.0, 0.9]
    assert [sweep.time for sweep in log.sweeps] == [0.0, 0.5, 1.0]
    (track,) = log.tracks
    assert (there(track.times).tolist(), track.span) == ([0.0, 0.5, 1.0], (0.0, 1.0))
    second = DriveStudioReader(tmp_path, cameras=[1], first_frame=1).read()
    assert [view.stamp for view in second.views] == own[1:]
    assert second.views[0].time == pytest.approx(0.3)  # 30 ms of 100: the box of the last frame is the last thing
    first = DriveStudioReader(tmp_path, cameras=[0]).data_hash()
    (tmp_path / "timestamps_1.txt").unlink()
    assert DriveStudioReader(tmp_path, cameras=[0]).data_hash() == first


def test_a_log_without_a_clock_says_so(tmp_path):
    (make_nuscenes(tmp_path) / "timestamps.txt").unlink()
    log = DriveStudioReader(tmp_path).read()
    assert [note.split(":")[0] for note in log.notes] == ["no clock"]
    assert (log.frame_rate, log.frames[0].seconds, log.sweeps[0].stamp) == (None, None, None)


def test_own_stamps_need_own_poses_and_a_clock(tmp_path):
    write_stamps(make_waymo(tmp_path / "waymo"), [1, 2, 3], "timestamps_0.txt")
    write_stamps(make_nuscenes(tmp_path / "clockless"), [1, 2, 3], "timestamps_0.txt")
    (tmp_path / "clockless/timestamps.txt").unlink()
    write_stamps(make_nuscenes(tmp_path / "short"), [1, 2], "timestamps_0.txt")
    for name, said in (("waymo", "no poses of their own"), ("clockless", "no timestamps.txt"), ("short", "got 2")):
        (problem,) = DriveStudioReader(tmp_path / name).check()
        assert problem.path == tmp_path / name / "timestamps_0.txt"
        assert said in problem.message


@pytest.fixture
def decoded(monkeypatch) -> Counter[str]:
    """How often each image was decoded."""
    counts: Counter[str] = Counter()

    def count(path: Path, *arguments):
        counts[path.stem] += 1
        return read_image(path, *arguments)

    read_image = contents.read_image
    monkeypatch.setattr(contents, "read_image", count)
    return counts


def same_frame(frame: Frame, other: Frame) -> bool:
    parts = [(frame.image, other.image), (frame.sky, other.sky), (frame.human, other.human)]
    parts += [(frame.vehicle, other.vehicle), (frame.depth, other.depth)]
    return all(torch.equal(*part) for part in parts)


def same_sweep(sweep: Sweep, other: Sweep) -> bool:
    parts = [(sweep.points, other.points), (sweep.colors, other.colors), (sweep.colored, other.colored)]
    return all(torch.equal(*part) for part in parts)


@FLAVORS
def test_opening_splitting_and_measuring_a_log_decodes_no_image(make, tmp_path, monkeypatch):
    def load(image: ImageFile.ImageFile) -> None:
        raise AssertionError(f"{image.filename} was decoded")

    monkeypatch.setattr(ImageFile.ImageFile, "load", load)
    log = DriveStudioReader(make(tmp_path, frames=6)).read()
    parts = split(log, stride=3, offset=1)
    assert log.radius > 0
    assert (len(log.views), len(parts.train), parts.held_out_indices) == (12, 8, {1, 4})
    assert len(log.frames[2:5]) == 3
    with pytest.raises(AssertionError, match=r"000_0\.(jpg|png) was decoded"):
        log.frames[0]


def test_each_image_is_decoded_once_while_there_is_room(tmp_path, decoded):
    log = DriveStudioReader(make_nuscenes(tmp_path)).read()
    assert log.sweeps[1].colored.any()
    assert set(decoded) == {"001_0", "001_1"}  # which are left for the frames
    first = list(log.frames)
    for frame, again in zip(first, log.frames, strict=True):
        assert same_frame(frame, again)
    assert len(list(log.sweeps)) == 3
    assert set(decoded.values()) == {1}
    assert len(decoded) == 6


@FLAVORS
def test_without_room_everything_is_read_anew_and_the_same(make, tmp_path, decoded):
    log, forgetful = DriveStudioReader(make(tmp_path)).read(), DriveStudioReader(tmp_path, cache_mb=0).read()
    for index in (5, 0, 3, 0):
        assert same_frame(forgetful.frames[index], log.frames[index])
        assert forgetful.frames[index] is not forgetful.frames[index]
    for index in (2, 0, 2):
        assert same_sweep(forgetful.sweeps[index], log.sweeps[index])
    # Once for log; for the other three times at each visit of frame 0, and once for the sweep.
    assert decoded["000_0"] == 1 + 2 * 3 + 1


@FLAVORS
def test_a_gray_sweep_is_the_sweep_without_its_colors(make, tmp_path):
    """The vehicle passes the points that stand around, so that the cameras of an instant see others than the first."""
    log = DriveStudioReader(make(tmp_path, frames=10)).read()
    for gray, sweep in zip(log.sweeps.gray(), log.sweeps, strict=True):
        assert (gray.index, gray.points.tolist()) == (sweep.index, sweep.points.tolist())
        assert torch.equal(gray.colored, sweep.colored)
    assert len({int(gray.colored.sum()) for gray in log.sweeps.gray()}) > 1


BARREL = [-0.3, 0.05, 0.002, -0.001, 0.01]
"""Moves pixels of a 40x24 image by up to 3.38, of one half as large by half of that."""
SLIGHT = [0.05, 0.0, 0.0, 0.0, 0.0]
"""By up to 0.378."""


def with_lenses(root):
    """A log whose first camera is a pinhole."""
    make_waymo(root, cameras=3)
    for camera, lens in ((1, BARREL), (2, SLIGHT)):
        write_lines(root / f"intrinsics/{camera}.txt", [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, *lens])
    return root


@pytest.mark.parametrize(("width", "shifts"), [(None, ("3.38", "0.378")), (20, ("1.69", "0.189"))])
def test_cameras_have_their_lenses_and_notes_say_how_far_they_move_pixels(width, shifts, tmp_path):
    """However little that is: a plan decides what is simulated."""
    log = DriveStudioReader(with_lenses(tmp_path), width=width).read()
    pinhole, *cameras = (view.camera for view in log.frames.views[-3:])
    assert pinhole.distortion is None
    for camera, lens in zip(cameras, (BARREL, SLIGHT), strict=True):
        assert torch.equal(there(camera.distortion), torch.tensor(lens))
    first, second = shifts
    assert log.notes[0] == f"camera 1: its lens moves pixels by up to {first}"
    assert log.notes[1] == f"camera 2: its lens moves pixels by up to {second}"
    assert len(log.notes) == 2
