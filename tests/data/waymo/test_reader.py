"""What is read of a drive in either version equals the plan that it was written from."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from sparsestreet.data.convert import Source, convert
from sparsestreet.data.drivestudio import DriveStudioWriter
from sparsestreet.data.problems import LogError
from sparsestreet.data.waymo import WaymoReader
from sparsestreet.data.waymo.reader import find_segments
from sparsestreet.geometry import quaternions as quat
from tests.conftest import unchecked
from tests.data.plan import moved
from tests.data.waymo import records
from tests.data.waymo.drive import EXPOSURE, HALF_SPIN, LENS, READOUT, Drive
from tests.typed import there

CLOCK = 240
"""Nanoseconds: doubles of 1.5e9 seconds are so far apart."""
PLACE = 3e-6
"""Meters: what the car drives in that time."""


def test_poses_and_stamps(root, drive):
    recording = WaymoReader(root=root).recording()
    assert [(shot.frame, shot.camera) for shot in recording.shots] == [(f, c) for f in range(4) for c in range(2)]
    assert recording.frame_stamps == tuple(drive.stamps.tolist())
    for shot in recording.shots:
        camera = drive.cameras[shot.camera]
        assert abs(shot.stamp - drive.image_stamp(shot.frame, camera)) <= CLOCK
        expected = drive.world_from_camera(shot.frame, camera)
        # float32 velocities of a pose at the same instant change nothing.
        np.testing.assert_allclose(shot.world_from_camera.numpy(), expected, rtol=0, atol=PLACE)
        assert shot.exposure == pytest.approx(EXPOSURE / 1e9)
    vehicle = there(WaymoReader(root=root, first_frame=1).recording().vehicle)
    assert vehicle.stamps.tolist() == drive.stamps[1:].tolist()
    expected = np.stack([drive.frame_pose(frame) for frame in (1, 2, 3)])
    np.testing.assert_allclose(vehicle.poses.numpy(), expected, rtol=0, atol=PLACE)


def test_a_pose_of_another_instant_is_moved_to_the_middle_of_the_readout(tmp_path):
    drive = Drive(pose_delays={"front": 4_400_000, "left": -3_100_000}, yaw_rate=0.6)
    records.write_drive(tmp_path, drive)
    errors, turns = [], []
    for shot in WaymoReader(root=tmp_path).recording().shots:
        expected = torch.from_numpy(drive.world_from_camera(shot.frame, drive.cameras[shot.camera]))
        errors.append((shot.world_from_camera[:3, 3] - expected[:3, 3]).norm())
        turns.append((shot.world_from_camera[:3, :3] - expected[:3, :3]).abs().max())
    # On a circle v dt leaves v w dt^2 / 2 = 58 micrometers; a velocity of the wrong axes turns by 0.03 w dt = 8e-5.
    assert max(errors) < 70e-6
    # The angular velocity is constant in the vehicle's frame, so only the clock's rounding is left.
    assert max(turns) < 1e-6


def test_shutters_against_finite_differences_of_the_plan(root, drive):
    for shot in WaymoReader(root=root).recording().shots:
        camera, middle = drive.cameras[shot.camera], drive.image_stamp(shot.frame, drive.cameras[shot.camera])
        ends = [middle - READOUT // 2, middle + READOUT // 2]
        begin, end = torch.from_numpy(drive.world_from_vehicle(np.array(ends)) @ camera.vehicle_from_camera)
        now = torch.from_numpy(drive.world_from_camera(shot.frame, camera))[:3, :3]
        translation = now.T @ (end[:3, 3] - begin[:3, 3])
        rotation = quat.to_rotation_vector(quat.from_matrix(now.T @ end[:3, :3] @ begin[:3, :3].T @ now))
        # Both ends of the readout are rounded by the clock; an arc of 0.0088 rad differs from its chord by 1.4e-6 m.
        torch.testing.assert_close(shot.shutter.translation.double(), translation, rtol=0, atol=2 * PLACE)
        torch.testing.assert_close(shot.shutter.rotation.double(), rotation, rtol=0, atol=1e-7)


@pytest.mark.parametrize("direction", range(6))
def test_the_declared_side_is_read_first(direction, tmp_path):
    drive = Drive(num_frames=1, directions={"front": direction, "left": 2}, synced=False)
    records.write_drive(tmp_path, drive)
    recording = WaymoReader(root=tmp_path).recording()
    front, left = (shot.shutter for shot in recording.shots)
    sides = {1: "top", 2: "left", 3: "bottom", 4: "right"}
    assert left.direction == "left"
    assert (front.direction if front else None) == sides.get(direction)


def test_points_come_back_to_a_millimeter(root, drive):
    sweeps = there(WaymoReader(root=root).recording().sweeps)
    assert sorted(sweeps) == [0, 1, 2, 3]
    for frame, sweep in sweeps.items():
        points = sweep.read().numpy()
        assert sweep.stamp == drive.stamps[frame]
        # float32 poses of a world 4 km away are rounded to 0.24 mm an axis.
        np.testing.assert_allclose(points, drive.points(frame), rtol=0, atol=1e-3)
        np.testing.assert_allclose(there(sweep.intensities)(), drive.intensities(frame), atol=1e-6)
        stood = (drive.world_from_vehicle(drive.stamps[frame]) @ drive.vehicle_from_lidar)[:3, 3]
        np.testing.assert_allclose(there(sweep.origin).numpy(), stood, rtol=0, atol=1e-3)


def test_points_lie_where_images_of_a_rolling_shutter_show_them(tmp_path):
    """As ``lidar_camera_projection`` does: each point by the column that shows it, on images of 1,920 x 1,440."""
    drive = Drive(scale=60, num_frames=1, labelled=())
    records.write_drive(tmp_path, drive)
    recording = WaymoReader(root=tmp_path).recording()
    points, seen, errors, still = recording.sweeps[0].read().numpy(), 0, [], []
    for shot in recording.shots:
        camera, pose = drive.cameras[shot.camera], shot.world_from_camera.numpy()
        sign = {"left": 1, "right": -1}[shot.shutter.direction]
        ahead = moved(np.linalg.inv(pose), points)[:, 2]
        for point in points[ahead > 2][::3]:
            _, truth = drive.read_at(0, camera, lambda stamp, point=point: point)
            if not (0 < truth[0] < camera.width and 0 < truth[1] < camera.height):
                continue
            tau = sign * (truth[0] / camera.width - 0.5)
            turn = quat.to_matrix(quat.from_rotation_vector(tau * shot.shutter.rotation.double())).numpy()
            then = pose.copy()
            then[:3, 3] += pose[:3, :3] @ shot.shutter.translation.double().numpy() * tau
            then[:3, :3] = pose[:3, :3] @ turn
            errors.append(np.linalg.norm(drive.pixels(camera, then, point[None])[0] - truth))
            still.append(np.linalg.norm(drive.pixels(camera, pose, point[None])[0] - truth))
            seen += 1
    # Points are good to 0.4 mm, 0.4 pixels at 2 m.
    assert seen > 15
    assert max(errors) < 0.5
    assert max(still) > 5


def test_the_options_that_a_preset_of_drivestudio_has(root, drive, tmp_path):
    """Lenses leave images and masks, as they leave those of a folder in its layout; far returns are cut; the box of the
    scene lies along the first pose of the vehicle."""
    mask = tmp_path / "human/FRONT"
    mask.mkdir(parents=True)
    lines = np.zeros((24, 32), np.uint8)
    lines[:, ::3] = 255
    for frame in range(4):
        cv2.imwrite(str(mask / f"{frame:03d}.png"), lines)
    reader = WaymoReader(root=root, masks=tmp_path, cameras=["FRONT"])
    plain, options = reader.read(), replace(reader, undistort=True, lidar_ahead=(-2, 20), extent="first_pose").read()
    assert plain.views[0].camera.distortion is not None
    assert options.views[0].camera.distortion is plain.first_axes is None
    camera = drive.cameras[0]
    k = camera.intrinsics
    shifted = k - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV counts from the first pixel's center
    for one, other in zip(plain.frames, options.frames, strict=True):
        expected = cv2.undistort(one.image.numpy(), shifted, np.array(LENS))
        # Both interpolate with weights of 1/32 of a pixel.
        assert np.abs(other.image.numpy().astype(int) - expected.astype(int)).max() <= 2
    own = replace(reader, masks=None)  # of which one image has some, drawn by hand
    given, labels = (
        (plain.frames[1], options.frames[1]),
        (own.read().frames[1], replace(own, undistort=True).read().frames[1]),
    )
    (front,) = replace(reader, undistort=True).recording().rig
    take_out = there(front.undistortion)  # the images above say that it is right
    for one, other in (given, labels):
        recorded, found = there(one.human).numpy(), there(other.human).numpy()
        seen = take_out(255 * recorded.astype(np.uint8)) > 0
        assert np.array_equal(found, seen)
        assert not np.array_equal(found, recorded)
    assert 0 < len(options.sweeps[1].points) < len(plain.sweeps[1].points)
    pose = drive.frame_pose(0)
    np.testing.assert_allclose(there(options.first_axes).numpy(), pose[:3, :3], atol=1e-6)


@pytest.mark.parametrize("direction", [1, 2, 3, 4])
def test_boxes_are_at_their_own_instants(direction, tmp_path):
    drive = Drive(directions={"front": direction, "left": 4})
    records.write_drive(tmp_path, drive)
    (car,) = there(WaymoReader(root=tmp_path).recording().boxes)
    assert (car.name, car.class_name, car.frames.tolist()) == ("car-1", "Vehicle", [0, 1, 2, 3])
    np.testing.assert_allclose(car.sizes, np.tile(drive.box_size, (4, 1)), rtol=1e-12)
    for frame, (stamp, pose) in enumerate(zip(there(car.stamps), car.poses, strict=True)):
        # The camera's clock is rounded, and it is moved on by a velocity for up to half of its readout.
        assert abs(stamp - drive.seen_stamp(frame)) < 1000
        np.testing.assert_allclose(pose[:3, 3], drive.world_from_box(drive.seen_stamp(frame))[:3, 3], atol=1e-9)
        # A box turns about the vehicle's axis alone, which leans by 0.03: 0.03 * 0.06 are left of the plan's.
        np.testing.assert_allclose(pose[:3, :3], drive.world_from_box(stamp)[:3, :3], atol=3e-3)


def test_both_versions_have_the_same_boxes(roots):
    if 2 not in roots:
        pytest.skip("version 2 needs pyarrow: pip install 'sparsestreet[parquet]'")
    (one,), (other,) = (there(WaymoReader(root=root).recording().boxes) for root in roots.values())
    assert one.stamps == other.stamps
    assert np.array_equal(one.poses, other.poses)


def test_boxes_of_the_lidar_are_of_the_instant_when_the_beam_crossed_them(tmp_path):
    drive = Drive(synced=False)
    records.write_drive(tmp_path, drive)
    (car,) = there(WaymoReader(root=tmp_path).recording().boxes)
    for frame, (stamp, pose) in enumerate(zip(there(car.stamps), car.poses, strict=True)):
        assert abs(stamp - drive.box_stamp(frame)) <= 1
        assert abs(stamp - drive.begin(frame) - HALF_SPIN) < 5_000_000
        np.testing.assert_allclose(pose[:3, 3], drive.world_from_box(stamp)[:3, 3], atol=1e-7)


def test_the_log_has_images_lenses_and_masks(root, drive):
    log = WaymoReader(root=root).read()
    assert (log.num_frames, log.num_cameras, len(log.sweeps), len(log.tracks)) == (4, 2, 4, 1)
    for frame in log.frames:
        index, place = frame.indices
        camera = drive.cameras[place]
        assert np.array_equal(frame.image.numpy(), drive.image(index, camera))
        np.testing.assert_allclose(frame.camera.intrinsics.numpy(), camera.intrinsics, rtol=1e-7)
        np.testing.assert_allclose(frame.camera.distortion.numpy(), LENS, rtol=1e-7)
        assert (frame.sky is not None) == ((index, place) == (1, 0))
    labelled = log.frames[2]
    assert labelled.sky.float().sum() == 6 * 32
    assert labelled.vehicle.float().sum() == 4 * 5
    assert labelled.human.float().sum() == 4 * 3
    assert "1 of 8 images have masks" in " ".join(log.notes)


def test_a_window_a_camera_and_a_width(root, drive):
    log = WaymoReader(root=root, cameras=["FRONT_LEFT"], first_frame=1, last_frame=2, width=16, lidar=False).read()
    assert [view.indices for view in log.views] == [(0, 0), (1, 0)]
    assert log.frames[0].image.shape == (12, 16, 3)
    assert len(log.sweeps) == 0
    assert abs(log.views[0].stamp - drive.image_stamp(1, drive.cameras[1])) <= CLOCK
    assert log.tracks[0].frames.tolist() == [0, 1]


def test_a_sound_drive_has_no_problems_and_a_hash(root):
    reader = WaymoReader(root=root)
    assert reader.check() == []
    assert reader.data_hash() == WaymoReader(root=root).data_hash()


def test_a_segment_becomes_drivestudios_flavor_of_waymo(roots, drive, tmp_path):
    """As its own preprocessing writes it: the vehicle's pose of the frame, and the calibrated mounts."""
    with unchecked():
        log = WaymoReader(root=roots[1]).read()
        convert(log, Source(log.name, "0" * 12), DriveStudioWriter(), tmp_path / "out")
    assert log.vehicle is not None
    poses = log.dataset_from_world @ log.vehicle.poses
    for frame in range(log.num_frames):
        found = np.loadtxt(tmp_path / f"out/ego_pose/{frame:03d}.txt")
        np.testing.assert_allclose(found, poses[frame].numpy(), rtol=0, atol=1e-6)
    for number, camera in enumerate(drive.cameras[:2]):
        mount = np.loadtxt(tmp_path / f"out/extrinsics/{number}.txt")
        # x ahead, as Waymo's cameras have it; the path is a chord of the curve between two frames.
        right = camera.vehicle_from_camera @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
        np.testing.assert_allclose(mount, right, rtol=0, atol=0.01)
    assert np.fromfile(tmp_path / "out/lidar/000.bin", np.float32).size % 14 == 0


A, B = "1005_1_2_3", "2005_4_5_6"


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    root = tmp_path_factory.mktemp("two")
    for name in (A, B):
        records.write_drive(root / "training" / "part", Drive(num_frames=1), name)
    (root / "list.txt").write_text(f"segment-{B}_with_camera_labels\n{A}\n")
    return root


@pytest.mark.parametrize(
    ("scene", "name"),
    [
        (A, A),
        (f"segment-{B}_with_camera_labels.tfrecord", B),
        (0, B),
        (1, A),
        # Hydra and YAML take digits and underscores for a number.
        (2005456 * 10**20, None),
    ],
)
def test_by_name_or_by_place_in_a_list(scene, name, two):
    reader = WaymoReader(root=two, scene=scene, scenes=two / "list.txt")
    if name is None:
        with pytest.raises(ValueError, match=f"is not in {two}: data.log.scene must be one of {A}, {B}"):
            reader.read()
    else:
        assert reader.read().name == name


def test_a_name_that_was_taken_for_a_number(tmp_path):
    name = "10023947602400723454_1120_000_1140_000"
    records.write_drive(tmp_path, Drive(num_frames=1), name)
    assert WaymoReader(root=tmp_path, scene=int(name)).read().name == name


def test_a_choice_that_is_open(two):
    with pytest.raises(ValueError, match=f"must name one of the segments in {two}: {A}, {B}"):
        WaymoReader(root=two).read()
    with pytest.raises(ValueError, match=f"is a place in a list of segments: name the list .* {A}, {B}"):
        WaymoReader(root=two, scene=0).read()
    with pytest.raises(ValueError, match=f"is not within the 2 segments .* {A}, {B}"):
        WaymoReader(root=two, scene=2, scenes=two / "list.txt").read()
    with pytest.raises(ValueError, match=r"cameras \['SIDE_LEFT'\] must be different ones of the log's"):
        WaymoReader(root=two, scene=A, cameras=["SIDE_LEFT"]).read()


def test_a_folder_of_neither_or_both(tmp_path):
    with pytest.raises(LogError, match="there is no such folder"):
        find_segments(tmp_path / "absent")
    with pytest.raises(LogError, match="holds neither"):
        find_segments(tmp_path)
    for path in ("1.tfrecord", "vehicle_pose/1.parquet"):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).touch()
    with pytest.raises(LogError, match="1 segments of version 1"):
        find_segments(tmp_path)


def test_masks_of_a_user_replace_those_of_waymo(tmp_path):
    from PIL import Image

    records.write_drive(tmp_path / "log", Drive(num_frames=2))
    for frame in range(2):
        path = tmp_path / "masks" / "sky" / "FRONT" / f"{frame:03d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (32, 24), 255 * frame).save(path)
    log = WaymoReader(root=tmp_path / "log", masks=tmp_path / "masks").read()
    assert [None if one.sky is None else bool(one.sky.any()) for one in log.frames] == [False, None, True, None]
    assert log.masks == {"sky": "given"}
    own = WaymoReader(root=tmp_path / "log").read()
    assert own.masks == dict.fromkeys(("sky", "human", "vehicle"), "shipped")
    # Frame 1 of FRONT has labels made by hand: they are not mixed with the user's.
    assert {one.vehicle for one in log.frames} == {None}
    assert "by hand" not in " ".join(log.notes)
    (tmp_path / "masks" / "sky" / "FRONT" / "001.png").unlink()
    (problem,) = WaymoReader(root=tmp_path / "log", masks=tmp_path / "masks").check()
    assert problem.path.name == "001.png"
