"""Libraries of others read the written files as we do. Each test skips where its library is not installed.

They need packages that they do not import here: install them with --no-deps, and tri3d's numba and llvmlite too.
"""

import numpy as np
import pytest

from sparsestreet.data.waymo import WaymoReader
from sparsestreet.data.waymo.v1.segment import RecordSegment
from tests.data.waymo import records, tables
from tests.data.waymo.drive import Drive
from tests.data.waymo.records import NAME
from tests.data.waymo.tables import FRAME, LASER, SEGMENT, Row
from tests.typed import there


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


def test_tri3d_finds_the_same_points_boxes_and_images(tmp_path):
    """tri3d 0.2 asks for some tables and columns that we do not read, and for stamps that survive its arithmetic."""
    waymo = pytest.importorskip("tri3d.datasets.waymo", reason="tri3d, numba or llvmlite is not installed")
    drive = Drive(synced=False, start=1_532_402_928_000_000_000)
    root = tmp_path / "training"
    extra: Row = {f"{kind}.{axis}": 0.0 for kind in ("speed", "acceleration") for axis in "xyz"}
    extra |= {"num_lidar_points_in_box": 1, "num_top_lidar_points_in_box": 1}
    extra |= {"difficulty_level.detection": 1, "difficulty_level.tracking": 1}

    def change(component: str, rows: list[Row]) -> list[Row]:
        return [row | extra for row in rows] if component == "lidar_box" else rows

    tables.write_drive(root, drive, change=change)
    for component in ("camera_box", "lidar_segmentation"):
        tables.write(root / component / f"{NAME}.parquet", "Component", [{SEGMENT: NAME, FRAME: 0, LASER: 1}])
    theirs = waymo.Waymo(tmp_path, "training")
    ours = WaymoReader(root=tmp_path).recording()
    for frame in range(4):
        pose = drive.frame_pose(frame)
        points = [theirs._points(0, frame, "LIDAR_TOP")]
        world = points[0] @ pose[:3, :3].T + pose[:3, 3]
        # Theirs are float32 in the vehicle's frame, after poses of 4 km in float32.
        np.testing.assert_allclose(there(ours.sweeps)[frame].read()[: len(world)], world, atol=5e-3)
        assert there(ours.frame_stamps)[frame] / 1e9 == pytest.approx(theirs.timelines[0]["LIDAR_TOP"][frame], abs=1e-6)
        shots = [shot for shot in ours.shots if (shot.frame, shot.camera) == (frame, 0)]
        assert np.array_equal(theirs.image(0, frame, "IMG_FRONT"), ours.read_image(shots[0]))
    (car,), boxes = there(ours.boxes), theirs._boxes(0)
    for frame, box in enumerate(boxes):
        center = drive.frame_pose(frame) @ np.append(box.center, 1)
        np.testing.assert_allclose(car.poses[frame][:3, 3], center[:3], atol=1e-9)
        np.testing.assert_allclose(car.sizes[frame], box.size)
