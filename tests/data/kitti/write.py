"""Writes the plan as KITTI ships its raw data: one drive below the folder of its date."""

import time
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from tests.data.plan import Plan, levels, pose, turned

DATE = "2011_09_26"
DRIVE = f"{DATE}_drive_0099"
CAMERAS = ("image_00", "image_02", "image_03")
LATITUDE, LONGITUDE = 49.0, 8.4
RECTIFIED_PLACES = {"00": (0.0, 0, 0), "02": (0.0599, -0.0004, 0.0027), "03": (-0.4731, 0.0028, 0.0027)}
"""Of the rectified frame in each camera, as in the published calibration: its third number is not 0."""
OWN_CAR = np.array([[0.9, 0.4, -0.5], [-1.1, -1.3, -0.7]])
"""Returns of the own car, which a reader leaves out."""
MEAN_RADIUS = 6378137.0


def write_kitti(root: Path, plan: Plan) -> Path:
    """Returns the drive's folder. The vehicle of the plan is the IMU, its camera ``front`` is image_02."""
    folder = root / DATE / f"{DRIVE}_sync"
    folder.mkdir(parents=True)
    write_calibration(root / DATE, plan)
    for number, camera in enumerate(CAMERAS):
        write_images(folder / camera / "data", plan, gray=camera == "image_00", number=max(number - 1, 0))
        write_stamps(folder / camera / "timestamps.txt", plan.stamps + 10_500_000)
    write_lidar(folder / "velodyne_points" / "data", plan)
    for which, shift in (("", 0), ("_start", -plan.period // 2), ("_end", plan.period // 2)):
        write_stamps(folder / "velodyne_points" / f"timestamps{which}.txt", plan.stamps + shift)
    write_oxts(folder / "oxts", plan)
    write_tracklets(folder / "tracklet_labels.xml", plan)
    return folder


def numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def rectifying() -> np.ndarray:
    return pose(Rotation.from_euler("xyz", [0.004, -0.007, 0.01]).as_matrix(), (0, 0, 0))


def lidar_from_camera(plan: Plan, number: str) -> np.ndarray:
    """Where the camera image_NN sits: beside image_02 of the plan."""
    second, this = (pose(np.eye(3), RECTIFIED_PLACES[which]) for which in ("02", number))
    from_second = np.linalg.inv(plan.vehicle_from_lidar) @ plan.cameras[0].vehicle_from_camera
    return from_second @ second @ np.linalg.inv(this)


def write_calibration(folder: Path, plan: Plan) -> None:
    matrix = plan.cameras[0].intrinsics.copy()
    matrix[:2, 2] -= 0.5
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for number, place in RECTIFIED_PLACES.items():
        projection = matrix @ np.column_stack([np.eye(3), place])
        lines += [f"S_rect_{number}: {plan.cameras[0].width} {plan.cameras[0].height}"]
        # That of camera 0 counts for all: the others' is another rotation.
        turn = rectifying()[:3, :3] if number == "00" else turned(0.2)
        lines += [f"R_rect_{number}: {numbers(turn)}", f"P_rect_{number}: {numbers(projection)}"]
    (folder / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    first = np.linalg.inv(lidar_from_camera(plan, "00"))
    write_rigid(folder / "calib_velo_to_cam.txt", np.linalg.inv(rectifying()) @ first)
    write_rigid(folder / "calib_imu_to_velo.txt", np.linalg.inv(plan.vehicle_from_lidar))


def write_rigid(path: Path, transform: np.ndarray) -> None:
    lines = ["calib_time: 25-May-2012 16:47:16", f"R: {numbers(transform[:3, :3])}", f"T: {numbers(transform[:3, 3])}"]
    path.write_text("\n".join(lines) + "\n")


def write_images(folder: Path, plan: Plan, *, gray: bool = False, number: int = 0) -> None:
    folder.mkdir(parents=True)
    for frame in range(plan.num_frames):
        image = Image.fromarray(plan.image(frame, plan.cameras[number]))
        (image.convert("L") if gray else image).save(folder / f"{frame:010d}.png")


def stamp_text(stamp: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(stamp // 10**9)) + f".{stamp % 10**9:09d}"


def write_stamps(path: Path, stamps: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{stamp_text(int(stamp))}\n" for stamp in stamps))


def write_lidar(folder: Path, plan: Plan) -> None:
    """Each return where the sensor saw it at its own instant."""
    folder.mkdir(parents=True)
    for frame in range(plan.num_frames):
        points = np.concatenate([OWN_CAR, plan.sweep(frame)[0]])
        rows = np.column_stack([points, [*[0.5] * len(OWN_CAR), *levels(len(points) - len(OWN_CAR))]])
        rows.astype("<f4").tofile(folder / f"{frame:010d}.bin")


def write_oxts(folder: Path, plan: Plan) -> None:
    (folder / "data").mkdir(parents=True)
    write_stamps(folder / "timestamps.txt", plan.stamps + 14_000_000)
    poses = plan.world_from_vehicle(plan.stamps)
    scale = MEAN_RADIUS * np.cos(np.radians(LATITUDE))
    start = np.log(np.tan(np.pi * (90 + LATITUDE) / 360))
    # A car on a curve turns and drives by the same motion all the time, seen from itself.
    twist = np.real(np.asarray(logm(np.linalg.inv(poses[0]) @ poses[1]))) / (plan.period / 1e9)
    for frame, world_from_imu in enumerate(poses):
        east, north, up = world_from_imu[:3, 3] - poses[0, :3, 3]
        values = np.zeros(30)
        values[0] = 360 / np.pi * np.arctan(np.exp(start + north / scale)) - 90
        values[1], values[2] = LONGITUDE + np.degrees(east / scale), world_from_imu[2, 3]
        values[5], values[4], values[3] = Rotation.from_matrix(world_from_imu[:3, :3]).as_euler("ZYX")
        east, north, up = world_from_imu[:3, :3] @ twist[:3, 3]
        values[6], values[7], values[10] = north, east, up
        values[17:20] = twist[2, 1], twist[0, 2], twist[1, 0]
        (folder / "data" / f"{frame:010d}.txt").write_text(numbers(values) + "\n")


def lidar_from_box(plan: Plan, frame: int) -> np.ndarray:
    stamp = int(plan.stamps[frame])
    world_from_lidar = plan.world_from_vehicle(stamp) @ plan.vehicle_from_lidar
    return np.linalg.inv(world_from_lidar) @ plan.world_from_box(stamp)


def write_tracklets(path: Path, plan: Plan) -> None:
    """The plan's car from frame 0, and somebody who stands in the lidar's frame from frame 1, at first unset."""
    frames = range(plan.num_frames)
    car = [lidar_from_box(plan, frame) for frame in frames]
    person = [pose(turned(1.0), (8.0, 3.0, -0.6)) for _ in frames[1:]]
    objects = [
        tracklet("Car", plan.box_size, 0, car, [2] * len(car)),
        tracklet("Pedestrian", (0.6, 0.7, 1.8), 1, person, [0] + [1] * (len(person) - 1)),
    ]
    head = '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
    body = f"<tracklets version='0'><count>{len(objects)}</count><item_version>1</item_version>{''.join(objects)}"
    path.write_text(f"{head}<boost_serialization version='9'>{body}</tracklets></boost_serialization>\n")


def tracklet(name: str, size: tuple, first: int, poses: list[np.ndarray], states: list[int]) -> str:
    length, width, height = size
    items = []
    for transform, state in zip(poses, states, strict=True):
        bottom = transform[:3, 3] - 0.5 * height * transform[:3, 2]
        yaw, y_turn, x_turn = Rotation.from_matrix(transform[:3, :3]).as_euler("ZYX")
        # Published yaws go past half a turn.
        values = dict(
            zip(("tx", "ty", "tz", "rx", "ry", "rz"), (*bottom, x_turn, y_turn, yaw - 2 * np.pi), strict=True)
        )
        fields = "".join(f"<{key}>{float(value)!r}</{key}>" for key, value in values.items())
        items.append(f"<item>{fields}<state>{state}</state><occlusion>0</occlusion><truncation>0</truncation></item>")
    sizes = f"<h>{height}</h><w>{width}</w><l>{length}</l><first_frame>{first}</first_frame>"
    poses_text = f"<poses><count>{len(items)}</count><item_version>2</item_version>{''.join(items)}</poses>"
    return f"<item><objectType>{name}</objectType>{sizes}{poses_text}<finished>1</finished></item>\n"
