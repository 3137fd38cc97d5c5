"""What was found on genuine files, read by this reader. Nothing of them is in the repository."""

import struct

import numpy as np
import pytest

from sparsestreet.data.problems import LogError
from sparsestreet.data.waymo import WaymoReader
from sparsestreet.data.waymo.boxes import middle, readout
from sparsestreet.data.waymo.v1 import RecordSegment
from sparsestreet.data.waymo.v2 import Table, matrix
from tests.data.waymo import records
from tests.data.waymo.tables import FRAME, SEGMENT

ALL = ["FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"]
SIZES = [(1920, 1280)] * 3 + [(1920, 886)] * 2


@pytest.fixture(scope="module")
def frame(genuine) -> RecordSegment:
    return RecordSegment(next((genuine / "waymo_one_frame").glob("*.tfrecord")))


def test_both_shutter_directions_occur(genuine, frame):
    other = RecordSegment(genuine / "waymo_v1_header" / "val.tfrecord")
    for segment, direction in ((frame, 2), (other, 4)):
        assert {segment.cameras[name].direction for name in ALL} == {direction}
        assert [segment.cameras[name].size for name in ALL] == SIZES
        assert segment.check_files() == []
    assert (len(frame.boxes(0)), len(other.boxes(0))) == (75, 18)
    assert (len(frame.lidars["TOP"].inclinations), len(frame.lidars["REAR"].inclinations)) == (64, 0)


def test_cameras_follow_the_spin_of_the_lidar(frame):
    """25 to 76 ms after the stamp, 44 ms to read out; some 3 ms of exposure."""
    motions = frame.images(0)
    delays = {name: (middle(motion) - 1000 * frame.stamps[0]) / 1e6 for name, motion in motions.items()}
    expected = {"SIDE_LEFT": 25.6, "FRONT_LEFT": 38.0, "FRONT": 50.2, "FRONT_RIGHT": 62.8, "SIDE_RIGHT": 75.4}
    assert delays == pytest.approx(expected, abs=0.1)
    for motion in motions.values():
        assert 43.9e6 < readout(motion) < 44.3e6
        assert 0.0025 < motion.exposure < 0.004


def test_the_frame_has_images_and_masks_but_no_lidar(genuine):
    reader = WaymoReader(root=genuine / "waymo_one_frame", cameras=["FRONT", "SIDE_LEFT"], width=480)
    log = reader.read()
    assert [(view.camera.width, view.camera.height) for view in log.views] == [(480, 320), (480, 222)]
    notes = " ".join(log.notes)
    assert "no lidar" in notes
    assert "columns from the left" in notes
    assert "2 of 2 images have masks" in notes
    front = log.frames[0]
    assert 0.05 < front.sky.float().mean() < 0.6
    # Sky is above: the upper quarter has most of it.
    assert front.sky[:80].sum() > 0.6 * front.sky.sum()


def test_a_record_without_images_says_so(genuine):
    (problem,) = WaymoReader(root=genuine / "waymo_v1_header").check()
    assert problem.message == "there are no images of FRONT, FRONT_LEFT, FRONT_RIGHT"


def test_cars_are_where_their_boxes_are(genuine):
    """Most pixels inside the outline of a near parked car's box are labelled as a vehicle's."""
    log = WaymoReader(root=genuine / "waymo_one_frame", cameras=ALL).read()
    shares = []
    for view, shown in zip(log.views, log.frames, strict=True):
        for track in log.tracks:
            at = view.camera.camera_from_world.double() @ track.world_from_object[0, :, 3]
            u, v, depth = (view.camera.intrinsics.double() @ at[:3]).tolist()
            if track.class_name != "Vehicle" or not 3 < depth < 20:
                continue
            column, row = int(u / depth), int(v / depth)
            if 100 < column < view.camera.width - 100 and 50 < row < view.camera.height - 50:
                shares.append(float(shown.vehicle[row - 20 : row + 20, column - 20 : column + 20].float().mean()))
    assert len(shares) >= 4
    assert np.median(shares) == 1.0


def test_version_2_in_single_precision(genuine):
    """199 poses, row by row, as float32; the other components are not there, which is said."""
    pytest.importorskip("pyarrow", reason="version 2 needs pyarrow: pip install 'sparsestreet[parquet]'")
    root = genuine / "waymo_v2_parquet"
    table = Table(next((root / "vehicle_pose").glob("*.parquet")), "VehiclePoseComponent")
    rows = table.rows([SEGMENT, FRAME], ["world_from_vehicle.transform"])
    poses = np.array([matrix(row, "world_from_vehicle.transform", table.path) for row in rows]).reshape(-1, 4, 4)
    assert len(poses) == 199
    assert (poses[:, 3] == [0, 0, 0, 1]).all()
    assert all(value == struct.unpack("f", struct.pack("f", value))[0] for value in poses[0].ravel())
    with pytest.raises(LogError, match="component camera_calibration of the segment is missing"):
        WaymoReader(root=root).read()


@pytest.mark.parametrize("packed", [True, False])
def test_waymo_own_messages_say_the_same(packed, drive, tmp_path):
    """waymo-open-dataset-tf-2-12-0, from messages whose repeated numbers are packed or not."""
    messages = pytest.importorskip(
        "waymo_open_dataset.dataset_pb2", reason="waymo-open-dataset-tf-2-12-0 is not installed"
    )
    payload = records.message(drive, 1)
    if not packed:
        payload = b"".join((records.data(1, records.context(drive, packed=False)), payload))
    frame = messages.Frame()
    frame.ParseFromString(payload)
    # A message that stands twice is merged: read it as one, as the library wrote it.
    if not packed:
        del frame.context.camera_calibrations[2:], frame.context.laser_calibrations[2:]
    path = records.write(tmp_path / "1.tfrecord", [frame.SerializeToString()])
    segment = RecordSegment(path)
    assert (segment.name, segment.stamps) == (frame.context.name, [frame.timestamp_micros])
    for calibration, camera in zip(frame.context.camera_calibrations, segment.cameras.values(), strict=True):
        assert camera.intrinsic == tuple(calibration.intrinsic)
        assert camera.size == (calibration.width, calibration.height)
        assert camera.direction == calibration.rolling_shutter_direction
        assert camera.vehicle_from_camera.flatten().tolist() == list(calibration.extrinsic.transform)
    for calibration, lidar in zip(frame.context.laser_calibrations, segment.lidars.values(), strict=True):
        assert lidar.inclinations == tuple(calibration.beam_inclinations)
        assert lidar.limits == (calibration.beam_inclination_min, calibration.beam_inclination_max)
    assert segment.world_from_vehicle(0).flatten().tolist() == list(frame.pose.transform)
    for image, motion in zip(frame.images, segment.images(0).values(), strict=True):
        velocity = image.velocity
        assert motion.linear.tolist() == [velocity.v_x, velocity.v_y, velocity.v_z]
        assert motion.angular.tolist() == [velocity.w_x, velocity.w_y, velocity.w_z]
        assert (motion.pose_time, motion.exposure) == (image.pose_timestamp, image.shutter)
        assert (motion.trigger, motion.readout_done) == (image.camera_trigger_time, image.camera_readout_done_time)
    label, box = frame.laser_labels[0], segment.boxes(0)[0]
    theirs = label.camera_synced_box
    assert box.seen_box == (
        *(theirs.center_x, theirs.center_y, theirs.center_z),
        *(theirs.length, theirs.width, theirs.height, theirs.heading),
    )
    assert (box.name, box.kind, box.seen_by) == (label.id, label.type, label.most_visible_camera_name)
