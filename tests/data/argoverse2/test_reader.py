"""A log that was written in Argoverse 2's layout is read as it was planned."""

from pathlib import Path

import numpy as np
import pytest
import torch

from sparsestreet.data.argoverse2 import Argoverse2Reader
from tests.data.plan import Plan, moved
from tests.typed import there

pytest.importorskip("pyarrow", reason="feather files need pyarrow")

from tests.data.argoverse2.write import CAMERAS, LOG, MIDDLE, UUID, read_table, sweep_stamp, write_log, write_table

PLAN = Plan()
ARC = 1e-5
"""Meters. Between poses 5 ms apart the path is a chord: 2 m/s^2 (5 ms)^2 / 8 = 6e-6 m beside the planned arc."""


@pytest.fixture
def log(tmp_path) -> Path:
    return write_log(tmp_path)


def test_images_have_the_poses_of_their_own_stamps(log):
    recording = Argoverse2Reader(root=log, cameras=list(CAMERAS)).recording()
    assert [(shot.frame, shot.camera) for shot in recording.shots] == [(f, c) for f in range(4) for c in range(2)]
    for shot in recording.shots:
        planned, delay = CAMERAS[recording.rig[shot.camera].name]
        camera = next(one for one in PLAN.cameras if one.name == planned)
        assert shot.stamp == sweep_stamp(PLAN, shot.frame) + delay
        assert shot.stem == str(shot.stamp)
        expected = PLAN.world_from_vehicle(there(shot.stamp)) @ camera.vehicle_from_camera
        np.testing.assert_allclose(shot.world_from_camera.numpy(), expected, atol=ARC)
        error = recording.read_image(shot).numpy().astype(int) - PLAN.image(shot.frame, camera)
        assert np.abs(error).mean() < 2  # JPEG


def test_the_vehicle_is_where_it_was_at_the_stamps_of_the_frames(log):
    recording = Argoverse2Reader(root=log, cameras=list(CAMERAS), first_frame=1).recording()
    vehicle = there(recording.vehicle)
    assert tuple(vehicle.stamps.tolist()) == recording.frame_stamps
    np.testing.assert_allclose(vehicle.poses.numpy(), PLAN.world_from_vehicle(vehicle.stamps.numpy()), atol=ARC)
    driven = there(Argoverse2Reader(root=log, cameras=list(CAMERAS)).read())
    origin = driven.dataset_from_world[:3, 3]
    np.testing.assert_allclose(there(driven.vehicle).poses[1:, :3, 3] + origin, vehicle.poses[:, :3, 3], atol=1e-9)


def test_pixels_have_their_centers_at_half_and_the_lens_is_not_applied(log):
    recording = Argoverse2Reader(root=log, cameras=list(CAMERAS)).recording()
    for camera, planned in zip(recording.rig, PLAN.cameras, strict=True):
        np.testing.assert_allclose(camera.intrinsics.numpy(), planned.intrinsics, rtol=1e-6)  # float32
        assert (camera.distortion, camera.undistortion, camera.note) == (None, None, None)


@pytest.mark.parametrize(("kind", "atol"), [(np.float64, 1e-6), (np.float16, 3**0.5 * 2**-6)])
def test_returns_lie_where_they_were(kind, atol, tmp_path):
    """Float16 has steps of 2^-5 m from 32 to 64 m, so each of three coordinates is off by up to 2^-6 m."""
    recording = Argoverse2Reader(root=write_log(tmp_path, points=kind)).recording()
    for frame, sweep in there(recording.sweeps).items():
        _, stamps = PLAN.sweep(frame)
        expected = PLAN.world_points(frame)[np.argsort(stamps, kind="stable")]
        np.testing.assert_allclose(sweep.read().numpy(), expected, atol=atol)
        assert sweep.stamp == sweep_stamp(PLAN, frame)
        stood = PLAN.world_from_vehicle(there(sweep.stamp)) @ PLAN.vehicle_from_lidar
        np.testing.assert_allclose(there(sweep.origin).numpy(), stood[:3, 3], atol=1e-6)


def test_boxes_stand_at_the_stamps_of_their_sweeps(log):
    bollard, car = sorted(there(Argoverse2Reader(root=log).recording().boxes), key=lambda one: one.class_name)
    assert (car.name, car.class_name, car.frames.tolist()) == (UUID, "REGULAR_VEHICLE", [0, 1, 2, 3])
    assert there(car.stamps) == tuple((PLAN.stamps - MIDDLE).tolist())
    np.testing.assert_allclose(car.poses, PLAN.world_from_box(PLAN.stamps - MIDDLE), atol=1e-6)
    np.testing.assert_allclose(car.sizes, np.tile(PLAN.box_size, (4, 1)))
    assert (bollard.name, bollard.frames.tolist()) == ("bollard", [0])
    ego = PLAN.world_from_vehicle(PLAN.stamps[0] - MIDDLE)
    np.testing.assert_allclose(bollard.poses[0, :3, 3], moved(ego, np.array([[5, 3, 0.5]]))[0], atol=1e-6)


def test_it_reads_as_a_log(log):
    read = Argoverse2Reader(root=log.parent.parent, scene="7f00").read()
    assert (read.name, read.num_frames, read.num_cameras, len(read.sweeps), len(read.tracks)) == (LOG, 4, 2, 4, 2)
    assert [round(there(view.seconds), 6) for view in read.views[:4]] == [0.038, 0.026, 0.138, 0.126]
    assert there(read.frame_rate) == pytest.approx(10)
    assert [sweep.stamp for sweep in read.sweeps] == (PLAN.stamps - MIDDLE).tolist()
    assert Argoverse2Reader(root=log).check() == []
    assert f"{PLAN.num_frames} poses within a microsecond" in " ".join(read.notes)


def test_rows_of_the_own_car_are_marked_where_a_camera_shows_it(log):
    front, left = Argoverse2Reader(root=log, cameras=list(CAMERAS)).read().frames[:2]
    # 250 of 2048 rows are 2.9 of 24.
    assert there(front.ego).sum(1).tolist() == [0] * 21 + [32] * 3
    assert left.ego is None


def test_a_window_a_camera_and_a_width(log):
    reader = Argoverse2Reader(root=log, cameras=["ring_front_left"], first_frame=1, last_frame=2, width=16)
    read = reader.read()
    assert (read.num_frames, read.frames[0].image.shape) == (2, (12, 16, 3))
    assert read.frames[0].stamp == sweep_stamp(PLAN, 1) + 26_000_000
    assert [track.frames.tolist() for track in read.tracks] == [[0, 1]]
    torch.testing.assert_close(read.frames[0].camera.intrinsics[0, 2].item(), 7.875)
    with pytest.raises(ValueError, match="frames 0 to 4 are not within"):
        Argoverse2Reader(root=log, last_frame=4).read()
    with pytest.raises(ValueError, match="must be different ones of the log's"):
        Argoverse2Reader(root=log, cameras=["front"]).read()


def test_without_lidar_and_without_boxes(log):
    (log / "annotations.feather").unlink()
    read = Argoverse2Reader(root=log, lidar=False).read()
    assert (len(read.sweeps), read.tracks, read.num_frames) == (0, (), 4)
    assert [note.split(":")[0] for note in read.notes[-3:-1]] == ["no lidar", "no boxes"]


def test_a_log_is_named_by_its_first_characters(log):
    root = log.parent.parent
    other = log.parent / "7f11"
    other.mkdir()
    (other / "city_SE3_egovehicle.feather").write_bytes((log / "city_SE3_egovehicle.feather").read_bytes())
    assert Argoverse2Reader(root=root, scene="7f00").recording().name == LOG
    with pytest.raises(ValueError, match="there are 2 logs in"):
        Argoverse2Reader(root=root).recording()
    with pytest.raises(ValueError, match="2 of 2 logs are named 7f"):
        Argoverse2Reader(root=root, scene="7f").recording()
    with pytest.raises(ValueError, match="0 of 2 logs are named 8"):
        Argoverse2Reader(root=root, scene="8").recording()
    # As a command line reads 7e128381 and 12345678.
    with pytest.raises(ValueError, match=f"the number inf: put the name of the log into quotes, one of {LOG}, 7f11"):
        Argoverse2Reader(root=root, scene=float("inf")).recording()
    log.rename(log.parent / "12345678-0")
    assert Argoverse2Reader(root=root, scene=12345678).recording().name == "12345678-0"
    with pytest.raises(ValueError, match="no log of Argoverse 2 is in"):
        Argoverse2Reader(root=root / "train").recording()


def test_what_is_left_out_is_counted(log):
    """An image of a sweep, both images of another, and a sweep whose boxes stay."""
    for late in (0, 50_000_000):
        for name, (_, delay) in CAMERAS.items():
            (log / "sensors/cameras" / name / f"{sweep_stamp(PLAN, 2) + delay + late}.jpg").unlink()
    for stamp in (38_000_000, 88_000_000):
        (log / "sensors/cameras/ring_front_center" / f"{sweep_stamp(PLAN, 1) + stamp}.jpg").unlink()
    (log / "sensors/lidar" / f"{sweep_stamp(PLAN, 3)}.feather").unlink()
    read = Argoverse2Reader(root=log).read()
    assert [view.indices for view in read.views] == [(0, 0), (0, 1), (1, 1)]
    notes = " | ".join(read.notes)
    assert "1 sweeps have no image of these cameras" in notes
    assert "1 of 4 images are missing" in notes
    assert "1 boxes are of instants whose sweeps are not here" in notes


def test_its_hash_is_of_what_it_reads(log):
    before = Argoverse2Reader(root=log).data_hash()
    (log / "map").mkdir()
    (log / "map" / "city.json").write_text("{}")
    assert Argoverse2Reader(root=log).data_hash() == before
    table = read_table(log / "annotations.feather")
    write_table(log / "annotations.feather", table | {"tx_m": table["tx_m"] + 1})
    assert Argoverse2Reader(root=log).data_hash() != before
