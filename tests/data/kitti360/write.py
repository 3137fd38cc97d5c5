"""Writes the plan as KITTI-360 ships a sequence. Frame 2 has no pose, as where the car hardly moved."""

from pathlib import Path

import numpy as np
from PIL import Image

from tests.data.kitti.write import OWN_CAR, numbers, rectifying, write_images, write_stamps
from tests.data.plan import Plan, levels, pose, turned

SEQUENCE = "2013_05_28_drive_0003_sync"
PLAN = Plan(num_frames=6)
UNPOSED = 2
VEHICLE_FROM_IMU = np.diag([1.0, -1, -1, 1])
"""The IMU has y right and z down."""
PARKED = pose(turned(0.7), (4150.0, -2350.0, 31.8))
PARKED_SIZE = (4.0, 1.7, 1.5)
LABELED = (0, 1, 4)
SIDEWAYS = pose(turned(np.pi / 2) @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (0.7, 0.3, 1.8))
"""vehicle_from_camera of image_02, a fisheye that looks to the left."""


def write_kitti360(root: Path, plan: Plan = PLAN) -> Path:
    """The vehicle of the plan is that of the IMU; image_00 is its camera ``front``, image_01 ``left``."""
    images = root / "data_2d_raw" / SEQUENCE
    for number, camera in enumerate(("image_00", "image_01")):
        write_images(images / camera / "data_rect", plan, number=number)
        write_stamps(images / camera / "timestamps.txt", plan.stamps)
    write_calibration(root / "calibration", plan)
    lidar = root / "data_3d_raw" / SEQUENCE / "velodyne_points" / "data"
    lidar.mkdir(parents=True)
    for frame in range(plan.num_frames):
        points = np.concatenate([OWN_CAR, plan.sweep(frame)[0]])
        reflectances = [*[0.5] * len(OWN_CAR), *levels(len(points) - len(OWN_CAR))]
        np.column_stack([points, reflectances]).astype("<f4").tofile(lidar / f"{frame:010d}.bin")
    write_poses(root / "data_poses" / SEQUENCE / "poses.txt", plan)
    write_boxes(root / "data_3d_bboxes" / "train" / f"{SEQUENCE}.xml", plan)
    write_labels(root / "data_2d_semantics" / "train" / SEQUENCE / "image_00" / "semantic", plan)
    return root


def write_calibration(folder: Path, plan: Plan) -> None:
    folder.mkdir(parents=True)
    mounts, lines = {}, ["calib_time: 22-Feb-2014 10:00:00", "corner_dist: 0.1"]
    for number, camera in (("00", plan.cameras[0]), ("01", plan.cameras[1])):
        matrix = camera.intrinsics.copy()
        matrix[:2, 2] -= 0.5
        turn = rectifying() if number == "00" else pose(turned(-0.02), (0, 0, 0))
        # The files place cameras as they are before rectification.
        mounts[number] = VEHICLE_FROM_IMU @ camera.vehicle_from_camera @ turn
        projection = np.column_stack([matrix, [0.0 if number == "00" else -330.0, 0, 0]])
        lines += [f"S_rect_{number}: {float(camera.width)} {float(camera.height)}"]
        lines += [f"R_rect_{number}: {numbers(turn[:3, :3])}", f"P_rect_{number}: {numbers(projection)}"]
    (folder / "perspective.txt").write_text("\n".join(lines) + "\n")
    places = [f"image_{number}: {numbers(mount[:3])}" for number, mount in mounts.items()]
    (folder / "calib_cam_to_pose.txt").write_text("\n".join(places) + "\n")
    lidar_from_first = np.linalg.inv(VEHICLE_FROM_IMU @ plan.vehicle_from_lidar) @ mounts["00"]
    (folder / "calib_cam_to_velo.txt").write_text(numbers(lidar_from_first[:3]) + "\n")


def write_poses(path: Path, plan: Plan) -> None:
    path.parent.mkdir(parents=True)
    poses = plan.world_from_vehicle(plan.stamps) @ VEHICLE_FROM_IMU
    path.write_text("".join(f"{k} {numbers(poses[k][:3])}\n" for k in range(plan.num_frames) if k != UNPOSED))


def write_boxes(path: Path, plan: Plan) -> None:
    """A car that moves, annotated at each frame from 1 on, one that is parked, and a building."""
    path.parent.mkdir(parents=True)
    moving = [(13, 7, frame, plan.world_from_box(int(plan.stamps[frame])), plan.box_size) for frame in range(1, 6)]
    still = [(13, 8, -1, PARKED, PARKED_SIZE), (11, 1, -1, PARKED, (20, 10, 8))]
    items = [cuboid(index, *item) for index, item in enumerate(moving + still, 1)]
    path.write_text(f'<?xml version="1.0"?>\n<opencv_storage>\n{"".join(items)}</opencv_storage>\n')


def cuboid(index: int, semantic: int, instance: int, stamp: int, transform: np.ndarray, size: tuple) -> str:
    scaled = transform @ np.diag([*size, 1.0])
    fields = {"index": index, "label": "car", "semanticId": semantic, "instanceId": instance, "category": 0}
    fields |= {"timestamp": stamp, "dynamic": int(stamp >= 0), "start_frame": 0, "end_frame": 200}
    head = "".join(f"<{key}>{value}</{key}>" for key, value in fields.items())
    matrices = matrix("transform", scaled) + matrix("vertices", np.full((8, 3), 0.5))
    return f"<object{index}>{head}{matrices}</object{index}>\n"


def matrix(name: str, values: np.ndarray) -> str:
    rows, columns = values.shape
    data = numbers(values)
    return (
        f'<{name} type_id="opencv-matrix"><rows>{rows}</rows><cols>{columns}</cols><dt>f</dt>'
        f"<data>\n      {data}</data></{name}>"
    )


def write_labels(folder: Path, plan: Plan) -> None:
    """Sky above, a road below; a car in the left corner, a rider and a person in the right."""
    folder.mkdir(parents=True)
    labels = np.full((plan.cameras[0].height, plan.cameras[0].width), 7, np.uint8)
    labels[:10], labels[20:, :8], labels[20:, 24:28], labels[20:, 28:] = 23, 26, 25, 24
    for frame in LABELED:
        Image.fromarray(labels).save(folder / f"{frame:010d}.png")


def write_fisheye(root: Path, plan: Plan = PLAN) -> None:
    """Adds image_02: black, with a white dot where a lens of xi = 1 shows the direction (0.6, 0, 0.8).

    x = 0.6 / (0.8 + xi) = 1 / 3, so that the dot lies gamma1 / 3 = 8 pixels right of u0.
    """
    folder = root / "data_2d_raw" / SEQUENCE / "image_02" / "data_rgb"
    folder.mkdir(parents=True)
    pixels = np.zeros((24, 32, 3), np.uint8)
    pixels[11, 16] = 255
    for frame in range(plan.num_frames):
        Image.fromarray(pixels).save(folder / f"{frame:010d}.png")
    shape = "mirror_parameters:\n   xi:1.0\ndistortion_parameters:\n   k1:0.0\n   k2:0.0\n   p1:0.0\n   p2:0.0\n"
    place = "projection_parameters:\n   gamma1:24.0\n   gamma2:24.0\n   u0:8.0\n   v0:11.0\n"
    head = "%YAML:1.0\n---\nmodel_type:MEI\ncamera_name:image_02\nimage_width:32\nimage_height:24\n"
    (root / "calibration" / "image_02.yaml").write_text(head + shape + place)
    with (root / "calibration" / "calib_cam_to_pose.txt").open("a") as file:
        file.write(f"image_02: {numbers((VEHICLE_FROM_IMU @ SIDEWAYS)[:3])}\n")
