"""The drive of the plan, written as nuScenes publishes one, is read as it was planned."""

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.nuscenes import NuScenesReader
from sparsestreet.data.recording import Recording
from tests.data.nuscenes.written import CHANNELS, Written, sweep_end, token, write_nuscenes
from tests.data.plan import Plan, levels
from tests.typed import there

PLAN = Plan()


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Written:
    """Every frame a keyframe. Nobody changes it."""
    return write_nuscenes(tmp_path_factory.mktemp("nuscenes") / "drive", PLAN)


@pytest.fixture(scope="module")
def recording(drive) -> Recording:
    return NuScenesReader(root=drive.root).recording()


@pytest.fixture(scope="module")
def sparse(tmp_path_factory) -> Written:
    """Each third frame a keyframe, of eight."""
    return write_nuscenes(tmp_path_factory.mktemp("nuscenes") / "sparse", Plan(num_frames=8), keyframe_every=3)


def test_each_image_has_the_pose_and_the_stamp_of_its_own_instant(recording):
    found = {(shot.frame, recording.rig[shot.camera].name): shot for shot in recording.shots}
    assert len(found) == 8
    for camera in PLAN.cameras:
        for frame in range(4):
            shot = found[frame, CHANNELS[camera.name]]
            assert shot.stamp == PLAN.image_stamp(frame, camera)
            # Quaternions are written with 16 digits, 4 km from the origin.
            assert np.allclose(shot.world_from_camera, PLAN.world_from_camera(frame, camera), rtol=0, atol=1e-11)


def test_the_vehicle_is_where_it_was_at_the_images_of_the_first_camera(recording):
    first = next(camera for camera in PLAN.cameras if CHANNELS[camera.name] == recording.rig[0].name)
    stamps = np.array([PLAN.image_stamp(frame, first) for frame in range(4)])
    assert recording.vehicle.stamps.tolist() == stamps.tolist()
    assert np.allclose(recording.vehicle.poses, PLAN.world_from_vehicle(stamps), rtol=0, atol=1e-11)


def test_intrinsics_have_pixel_centers_at_a_half(drive, recording):
    for camera, planned in zip(recording.rig, PLAN.cameras, strict=True):
        assert (camera.name, camera.size, camera.distortion) == (CHANNELS[planned.name], (32, 24), None)
        assert np.allclose(camera.intrinsics, planned.intrinsics, rtol=1e-7)
    as_it_is = NuScenesReader(root=drive.root, principal_shift=0).recording().rig
    assert as_it_is[0].intrinsics[:2, 2].tolist() == [15.75, 11.0]
    half = NuScenesReader(root=drive.root, width=16, lidar=False).recording()
    assert half.rig[0].intrinsics[0].tolist() == [15.0, 0.0, 8.125]
    assert half.sweeps is None


def test_boxes_are_those_of_the_keyframes_at_their_stamps(recording):
    (boxes,) = there(recording.boxes)
    assert (boxes.name, boxes.class_name, boxes.frames.tolist()) == (token("one"), "vehicle.car", [0, 1, 2, 3])
    assert boxes.stamps == tuple(sweep_end(PLAN, frame) for frame in range(4))
    assert np.array_equal(boxes.sizes, [PLAN.box_size] * 4)
    assert np.allclose(boxes.poses, PLAN.world_from_box(np.array(boxes.stamps)), rtol=0, atol=1e-11)


def test_returns_are_where_they_were_and_the_own_car_has_none(recording):
    for frame, sweep in there(recording.sweeps).items():
        assert sweep.stamp == sweep_end(PLAN, frame)
        points = sweep.read()
        # One return of the roof was written too. float32 has steps of 4e-6 m at 45 m.
        assert np.allclose(points, PLAN.world_points(frame), rtol=0, atol=1e-5)
        np.testing.assert_allclose(sweep.intensities(), levels(len(points)), atol=1e-6)
        stood = PLAN.world_from_vehicle(sweep_end(PLAN, frame)) @ PLAN.vehicle_from_lidar
        assert np.allclose(there(sweep.origin), stood[:3, 3], rtol=0, atol=1e-6)


def test_the_log_that_follows(drive):
    log = NuScenesReader(root=drive.root).read()
    assert (log.name, log.num_frames, log.num_cameras, len(log.sweeps)) == ("scene-0061", 4, 2, 4)
    assert [view.stamp for view in log.views[:2]] == [PLAN.image_stamp(0, camera) for camera in PLAN.cameras]
    assert log.frame_rate == pytest.approx(10.0)
    start = PLAN.world_from_camera(0, PLAN.cameras[0])[:3, 3]
    assert np.allclose(log.dataset_from_world[:3, 3], start, rtol=0, atol=1e-11)
    assert torch.allclose(log.frames[0].camera.position, torch.zeros(3), atol=1e-6)
    for frame in log.frames:
        index, camera = frame.indices
        # JPEG of quality 98.
        assert abs(frame.image.numpy().astype(int) - PLAN.image(index, PLAN.cameras[camera])).max() <= 6
    assert NuScenesReader(root=drive.root).check() == []


def test_what_is_said_of_a_scene(recording):
    assert recording.notes == (
        "scene-0061 is read, at place 0 of v1.0-mini/scene.json",
        "1 of 4 boxes hold no return: their objects are hidden then, and are kept",
        "attributes of the boxes are not used, displacement tells what moves: vehicle.moving 4",
    )


def test_keyframes_alone_unless_all_images_are_wanted(sparse):
    recording = NuScenesReader(root=sparse.root).recording()
    plan = Plan(num_frames=8)
    assert recording.frame_stamps == tuple(sweep_end(plan, frame) for frame in (0, 3, 6))
    assert [shot.stamp for shot in recording.shots[::2]] == [plan.image_stamp(n, plan.cameras[0]) for n in (0, 3, 6)]
    assert recording.notes[1] == "keyframes alone are read, the 10 images between them with data.log.rate=all"


def test_all_images_are_grouped_around_those_of_the_front_camera(sparse):
    recording = NuScenesReader(root=sparse.root, rate="all").recording()
    plan = Plan(num_frames=8)
    front, left = plan.cameras
    assert recording.frame_stamps == tuple(plan.image_stamp(frame, front) for frame in range(8))
    # The left camera fires 51 ms after the front one: the next front image, 49 ms later, is nearer, but not its own.
    stamps = [shot.stamp for shot in recording.shots if shot.camera == 1]
    assert stamps == [plan.image_stamp(frame, left) for frame in range(8)]
    assert [shot.frame for shot in recording.shots] == [frame for frame in range(8) for _ in range(2)]
    assert {frame: sweep.stamp for frame, sweep in there(recording.sweeps).items()} == {
        frame: sweep_end(plan, frame) for frame in range(8)
    }
    (boxes,) = there(recording.boxes)
    assert boxes.frames.tolist() == [0, 3, 6]
    assert boxes.stamps == tuple(sweep_end(plan, frame) for frame in (0, 3, 6))
    assert recording.notes[1] == "boxes are annotated at 3 of 8 instants, and carried on between two with one"


def test_a_window_keeps_boxes_outside_of_it_apart(sparse):
    recording = NuScenesReader(
        root=sparse.root, rate="all", first_frame=2, last_frame=5, cameras=["CAM_FRONT_LEFT"]
    ).recording()
    assert [(shot.frame, shot.camera) for shot in recording.shots] == [(0, 0), (1, 0), (2, 0), (3, 0)]
    (boxes,) = there(recording.boxes)
    assert boxes.frames.tolist() == [-2, 1, 4]


def test_an_image_that_the_tables_lack(tmp_path):
    drive = write_nuscenes(tmp_path / "drive", PLAN)
    gone = token("file", "scene-0061", "CAM_FRONT_LEFT", 3)
    drive.edit("sample_data", lambda rows: rows.remove(next(row for row in rows if row["token"] == gone)))
    drive.edit("sample_data", lambda rows: [row.update(next="") for row in rows if row["next"] == gone])
    recording = NuScenesReader(root=drive.root).recording()
    assert "1 images are not in the tables, so some instants lack cameras" in recording.notes
    recording = NuScenesReader(root=drive.root, cameras=["CAM_FRONT_LEFT"]).recording()
    assert len(there(recording.frame_stamps)) == len(recording.shots) == 3
    with pytest.raises(ValueError, match=r"frames 3 to 3 hold no image of CAM_FRONT_LEFT: read other frames, or name"):
        NuScenesReader(root=drive.root, first_frame=3, last_frame=3).recording()


def test_objects_that_no_return_hit_are_left_out(tmp_path):
    drive = write_nuscenes(tmp_path / "drive", PLAN)
    drive.edit("sample_annotation", lambda rows: [row.update(num_lidar_pts=0) for row in rows])
    recording = NuScenesReader(root=drive.root).recording()
    assert recording.boxes == []
    assert "1 objects that no lidar or radar return hit at any keyframe are left out" in recording.notes
    drive.edit("sample_annotation", lambda rows: rows[2].update(num_radar_pts=1))
    (boxes,) = there(NuScenesReader(root=drive.root).recording().boxes)
    assert len(boxes.frames) == 4
    drive.write("sample_annotation", [])
    assert NuScenesReader(root=drive.root).recording().boxes is None
    assert NuScenesReader(root=drive.root).read().tracks == ()


@pytest.mark.parametrize(("scene", "rows"), [("scene-0061", 3), ("scene-0164", 4)])
def test_the_lowest_rows_of_the_back_camera_show_the_car(scene, rows, tmp_path):
    drive = write_nuscenes(tmp_path / "drive", PLAN)
    drive.edit("scene", lambda scenes: scenes[0].update(name=scene))
    drive.edit("sensor", lambda rows: rows[1].update(channel="CAM_BACK"))
    log = NuScenesReader(root=drive.root).read()
    back = log.frames[1]
    # 80 of 900 rows, or 146: 2.1 of 24, or 3.9, so three rows or four hold some of them.
    assert there(back.ego).any(1).tolist() == [False] * (24 - rows) + [True] * rows
    assert log.frames[0].ego is None
    # Masks that somebody made of another kind leave it.
    for frame in range(4):
        path = tmp_path / "masks/sky/CAM_BACK" / f"{drive.file('CAM_FRONT_LEFT', frame).stem}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (32, 24)).save(path)
    given = NuScenesReader(root=drive.root, masks=tmp_path / "masks").read().frames[1]
    assert torch.equal(there(given.ego), there(back.ego))


def test_the_hash_is_of_the_scene_in_whatever_tables(drive, tmp_path):
    other = write_nuscenes(tmp_path / "drive", PLAN)
    other.table("scene").parent.rename(other.root / "v1.0-trainval")
    other = Written(other.root, "v1.0-trainval")
    other.edit("scene", lambda rows: rows.insert(0, {**rows[0], "name": "scene-0001", "token": "other"}))
    other.edit("ego_pose", lambda rows: rows.insert(0, {**rows[0], "token": "other"}))
    before = NuScenesReader(root=drive.root).data_hash()
    assert NuScenesReader(root=other.root, scene="scene-0061").data_hash() == before
    other.edit("sample_annotation", lambda rows: rows[2]["translation"].__setitem__(0, 4150.0))
    assert NuScenesReader(root=other.root, scene="scene-0061").data_hash() != before


def test_masks_that_somebody_made(drive, tmp_path):
    folder = tmp_path / "masks" / "sky" / "CAM_FRONT"
    folder.mkdir(parents=True)
    reader = NuScenesReader(root=drive.root, masks=tmp_path / "masks")
    assert len(reader.check()) == 1
    for frame in range(4):
        path = drive.file("CAM_FRONT", frame)
        Image.new("L", (32, 24), 255 * (frame == 1)).save(folder / f"{path.stem}.png")
    log = reader.read()
    assert reader.check() == []
    assert [there(log.frames[index].sky).all().item() for index in (0, 2)] == [False, True]
    assert log.frames[1].sky is None
