"""A converted log is one that DriveStudio's own loaders read, in each of the flavors that we write.

What they open, know and compute is written down here from their source (ziyc/drivestudio at e59bda4: datasets/waymo and
datasets/nuscenes/*_sourceloader.py, datasets/dataset_meta.py).
"""

import dataclasses
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.convert import Source, convert
from sparsestreet.data.drivestudio import DriveStudioReader, DriveStudioWriter
from sparsestreet.data.drivestudio.annotations import role_of
from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog, VehiclePath
from sparsestreet.geometry import quaternions as quat
from sparsestreet.types import BodyPoses, Camera, Frame, Shutter, SparsePoints, Sweep, Track
from tests.data.plan import Plan, moved, pose, turned

RIGID, SMPL, DEFORMABLE = "RigidNodes", "SMPLNodes", "DeformableNodes"
NODES = {
    "waymo": {"Vehicle": RIGID, "Pedestrian": SMPL, "Cyclist": DEFORMABLE},
    "nuscenes": {
        "vehicle.bus.bendy": RIGID, "vehicle.bus.rigid": RIGID, "vehicle.car": RIGID, "vehicle.construction": RIGID,
        "vehicle.emergency.ambulance": RIGID, "vehicle.emergency.police": RIGID, "vehicle.motorcycle": RIGID,
        "vehicle.trailer": RIGID, "vehicle.truck": RIGID, "human.pedestrian.adult": SMPL,
        "human.pedestrian.child": SMPL, "human.pedestrian.construction_worker": SMPL,
        "human.pedestrian.police_officer": SMPL, "human.pedestrian.personal_mobility": DEFORMABLE,
        "human.pedestrian.stroller": DEFORMABLE, "human.pedestrian.wheelchair": DEFORMABLE, "animal": DEFORMABLE,
        "vehicle.bicycle": DEFORMABLE,
    },
}  # fmt: skip
"""The loaders' tables; a class outside of its table is a KeyError."""
ALL_CAMERAS = {"waymo": 5, "nuscenes": 6}
"""Whose poses are read with body poses, whichever cameras are asked for."""
WAYMO_FROM_OPENCV = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

PLAN = Plan(num_frames=5)
STAMPS = PLAN.stamps + 300_000_000 * (np.arange(5) >= 3)
"""Three frames are missing between the third and the fourth."""
WORLD = pose(turned(0.7, 0.1), np.array([4000.0, -2300.0, 25.0]))
"""dataset_from_world: turned and shifted."""
WIDTH, HEIGHT = 41, 23
NAMES = {"waymo": ("FRONT", "SIDE_LEFT"), "nuscenes": ("CAM_FRONT", "CAM_BACK_LEFT")}
NUMBERS = {"waymo": (0, 3), "nuscenes": (0, 3)}
CLASSES = {"waymo": ("Vehicle", "Pedestrian", "Cyclist"), "nuscenes": tuple(NODES["nuscenes"])}
FEW = {"waymo": CLASSES["waymo"], "nuscenes": ("vehicle.truck", "human.pedestrian.adult", "animal")}
FLAVORS = pytest.mark.parametrize("flavor", ["waymo", "nuscenes"])


def image_stamp(frame: int, camera: int) -> int:
    return int(STAMPS[frame]) + PLAN.cameras[camera].delay


def time_of(stamp: int) -> float:
    """The first image is the first of all that has a stamp, but for the sweeps; the last one ends the log."""
    first, last = int(STAMPS[0]), image_stamp(4, 1)
    return (stamp - first) / (last - first)


def from_dataset(matrices: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.linalg.inv(WORLD) @ matrices)


def crooked(flavor: str, classes: tuple[str, ...] | None = None) -> DrivingLog:
    """A curve in a turned and shifted world; cameras that fire apart; a gap; odd sizes; an object of each class, the
    last one at one frame; a body; all kinds of masks; what no flavor has room for too."""
    rng = np.random.default_rng(1)
    frames = []
    for frame in range(5):
        for number, planned in enumerate(PLAN.cameras):
            stamp = image_stamp(frame, number)
            world = PLAN.world_from_vehicle(stamp) @ planned.vehicle_from_camera
            camera = Camera(
                torch.linalg.inv(from_dataset(world)).float(),
                torch.from_numpy(planned.intrinsics).float(),
                WIDTH,
                HEIGHT,
                torch.tensor([-0.1, 0.02, 1e-3, -1e-3, 0.0]),
                Shutter(torch.tensor([0.0, 0.0, 0.3]), torch.tensor([0.0, 0.01, 0.0]), seconds=0.03)
                if number
                else None,
                0.008,
            )
            masks = {kind: torch.from_numpy(rng.random((HEIGHT, WIDTH)) > 0.5) for kind in ("sky", "human", "vehicle")}
            ego = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
            ego[-3:] = True
            image = torch.from_numpy(rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8))
            seconds = (stamp - int(STAMPS[0])) / 1e9
            frames.append(Frame(camera, time_of(stamp), frame, number, seconds, stamp, image=image, ego=ego, **masks))
    sweeps = tuple(
        Sweep(frame, time_of(stamp), points, torch.full_like(points, 0.5), torch.zeros(len(points), dtype=torch.bool),
              (stamp - int(STAMPS[0])) / 1e9, stamp)
        for frame, stamp in enumerate(STAMPS.tolist())
        for points in [torch.from_numpy(moved(np.linalg.inv(WORLD), PLAN.world_points(frame))).float()]
    )  # fmt: skip
    classes = CLASSES[flavor] if classes is None else classes
    tracks = tuple(track(number, name, 1 if name == classes[-1] else 4) for number, name in enumerate(classes))
    path = VehiclePath(from_dataset(PLAN.world_from_vehicle(STAMPS)), tuple(STAMPS.tolist()))
    return DrivingLog(
        "crooked", as_frames(frames), Sweeps.of(sweeps), tracks, 5, 2, torch.from_numpy(WORLD), vehicle=path,
        camera_names=NAMES[flavor],
    )  # fmt: skip


def track(number: int, class_name: str, count: int) -> Track:
    frames = np.array([0, 1, 3, 4])[:count]
    poses = from_dataset(PLAN.world_from_box(STAMPS[frames]) @ pose(np.eye(3), (0.0, 3.0 * number, 0)))
    times = torch.tensor([time_of(int(stamp)) for stamp in STAMPS[frames]], dtype=torch.float64)
    body = None
    if role_of(class_name) == "pedestrian":
        rotations = torch.nn.functional.normalize(
            torch.randn(count, 24, 4, generator=torch.manual_seed(number)), dim=-1
        )
        body = BodyPoses(rotations, torch.arange(count) != 1, torch.arange(10.0))
    size = torch.tensor([4.5, 1.9, 1.6])
    return Track(f"a b/{number}", class_name, torch.from_numpy(frames), poses, size, body, times)


def written(log: DrivingLog, folder: Path, flavor: Any = "auto") -> tuple[str, ...]:
    """What is said of it."""
    made = convert(log, Source(log.name, "0" * 12), DriveStudioWriter(jpeg_quality=None, flavor=flavor), folder)
    assert DriveStudioReader(folder).check() == []
    return (*made.losses, *made.notes)


def as_drivestudio(root: Path, flavor: str, cameras: tuple[int, ...]) -> tuple[dict[int, np.ndarray], list[np.ndarray]]:
    """Poses of cameras by number, and points by frame, in its world: what its loader opens, in its order."""
    mounted = flavor == "waymo"
    frames = range(len(list((root / ("ego_pose" if mounted else "lidar_pose")).iterdir())))
    columns = 14 if mounted else 4

    def text(path: str) -> np.ndarray:
        return np.loadtxt(root / path)

    start = np.linalg.inv(text("ego_pose/000.txt" if mounted else "extrinsics/000_0.txt"))
    poses, points = {}, []
    for camera in cameras:
        assert text(f"intrinsics/{camera}.txt").shape == (9,)
        for frame in frames:
            for kind in ("images/{}.jpg", "sky_masks/{}.png", *(f"fine_dynamic_masks/{k}/{{}}.png" for k in
                         ("all", "human", "vehicle"))):  # fmt: skip
                with Image.open(root / kind.format(f"{frame:03d}_{camera}")) as image:
                    assert image.size == (WIDTH, HEIGHT)
    for camera in range(ALL_CAMERAS[flavor]):
        if mounted:
            mount = text(f"extrinsics/{camera}.txt") @ WAYMO_FROM_OPENCV
            poses[camera] = np.stack([start @ text(f"ego_pose/{frame:03d}.txt") @ mount for frame in frames])
        else:
            poses[camera] = np.stack([start @ text(f"extrinsics/{frame:03d}_{camera}.txt") for frame in frames])
    for frame in frames:
        rows = np.fromfile(root / f"lidar/{frame:03d}.bin", np.float32).reshape(-1, columns)
        if mounted:
            rows = rows[rows[:, 13] == 0][:, 3:]
        at = start @ text(f"{'ego' if mounted else 'lidar'}_pose/{frame:03d}.txt")
        points.append(moved(at, rows[:, :3].astype(float)))
    return poses, points


@FLAVORS
def test_its_loaders_find_every_file_and_every_name(flavor, tmp_path):
    log, root = crooked(flavor), tmp_path / "out"
    written(log, root)
    poses, points = as_drivestudio(root, flavor, NUMBERS[flavor])
    back = DriveStudioReader(root).read()
    # Its world is the first pose's; ours keeps the data set's axes.
    first = PLAN.world_from_vehicle(STAMPS[0])
    if flavor == "nuscenes":
        first = PLAN.world_from_vehicle(image_stamp(0, 0)) @ PLAN.cameras[0].vehicle_from_camera
    for index, number in enumerate(NUMBERS[flavor]):
        for frame in range(5):
            stamp = STAMPS[frame] if flavor == "waymo" else image_stamp(frame, index)
            right = PLAN.world_from_vehicle(stamp) @ PLAN.cameras[index].vehicle_from_camera
            # Mounts are known by poses between which the vehicle drives on a chord of its curve (0.3 s: 23 mm).
            atol = 0.025 if flavor == "waymo" else 1e-4
            np.testing.assert_allclose(first @ poses[number][frame], right, rtol=0, atol=atol)
    for frame in range(5):
        np.testing.assert_allclose(moved(first, points[frame]), PLAN.world_points(frame), rtol=0, atol=1e-4)
    info = json.loads((root / "instances/instances_info.json").read_text())
    listed = json.loads((root / "instances/frame_instances.json").read_text())
    assert sorted(map(int, info)) == list(range(len(CLASSES[flavor])))
    assert sorted(map(int, listed)) == list(range(5))
    for key, entry in info.items():
        assert NODES[flavor][entry["class_name"]]
        assert [frame for frame in range(5) if int(key) in listed[str(frame)]] == entry["frame_annotations"][
            "frame_idx"
        ]
    assert [one.class_name for one in back.tracks] == [one.class_name for one in log.tracks]  # the log's own
    people = joblib.load(root / "humanpose/smpl.pkl")
    for key, person in people.items():
        for frame in np.flatnonzero(person["valid_mask"]):
            root_turn = torch.from_numpy(poses[person["selected_cam_idx"][frame].item()][frame][:3, :3]).float()
            joints = torch.cat([(root_turn @ person["smpl"]["global_orient"][frame].squeeze())[None],
                                person["smpl"]["body_pose"][frame]])  # fmt: skip
            assert joints.shape == (24, 3, 3)
            torch.zeros(3, 10)[0] = person["smpl"]["betas"][frame]  # takes tensors alone
            assert frame in info[str(key)]["frame_annotations"]["frame_idx"]
    roles = [role_of(name) for name in CLASSES[flavor]]
    assert len(people) == roles.count("pedestrian")


@FLAVORS
@pytest.mark.parametrize("name", ["REGULAR_VEHICLE", "Car", "vehicle.truck", "Person (sitting)", "rider", "animal",
                                  "Misc", "STROLLER", "human.pedestrian.child"])  # fmt: skip
def test_a_class_of_any_data_set_is_known_there_and_is_the_same_here(name, flavor, tmp_path):
    log = crooked(flavor, ("vehicle.car",))
    log = replace(log, tracks=(replace(log.tracks[0], class_name=name),))
    said = written(log, tmp_path / "out", flavor)
    (entry,) = json.loads((tmp_path / "out/instances/instances_info.json").read_text()).values()
    node = {"vehicle": RIGID, "pedestrian": SMPL, "cyclist": DEFORMABLE, "other": DEFORMABLE}[role_of(name)]
    assert NODES[flavor][entry["class_name"]] == node
    assert entry["original_class_name"] == name
    if flavor == "nuscenes" or role_of(name) != "other":
        assert role_of(entry["class_name"]) == role_of(name)
    assert any(f"{name} is {entry['class_name']} (1)" in line for line in said) == (entry["class_name"] != name)


LOST = {
    "shutter": "rolling shutters are lost (cameras 3)", "exposure": "exposure times are lost (8 to 8 ms)",
    "camera_from_world": "poses of images are lost", "stamp": "stamps of images are lost",
    "camera_names": "names of cameras are lost", "vehicle": "the path of the vehicle is lost",
    "name": "names of objects are lost", "class_name": "classes get names", "image": "images become JPEG",
    "sky": "sky masks are lost", "human": "human masks are lost", "ego": "masks of the recording car are lost",
    "world_from_object": "boxes are up to 30.0 ms from the stamps", "sparse_points": "7 sparse points are lost",
    "truth": "what cameras beside the recorded path would see", "tracks": "objects are left out",
    "sweeps": "1 frames without a sweep get an empty one, the first of them frame 2",
}  # fmt: skip
"""Field -> how its sentence begins."""
DERIVED = {
    "camera", "time", "seconds", "depth", "span", "times", "colors", "colored", "index", "frame_index", "camera_index",
    "notes", "carried_by", "origin", "first_axes", "hoods", "dirt", "dataset_from_world",
    "num_frames", "num_cameras", "frames", "masks",
}  # fmt: skip
"""Fields that follow from others, are of the reader or found in images, or are looked at one by one."""


def same(one: Any, other: Any, atol: float) -> bool:
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.shape == other.shape and torch.allclose(one.double(), other.double(), rtol=1e-6, atol=atol)
    if dataclasses.is_dataclass(one) and type(one) is type(other):
        return all(same(getattr(one, f.name), getattr(other, f.name), atol) for f in dataclasses.fields(one))
    return not isinstance(one, torch.Tensor) and not isinstance(other, torch.Tensor) and one == other


def in_dataset(log: DrivingLog, name: str, value: Any) -> Any:
    """Poses and points in the data set's world; a body turned to it."""
    if name == "camera_from_world":
        return torch.linalg.inv(value.double() @ torch.linalg.inv(log.dataset_from_world))
    if name == "world_from_object":
        return log.dataset_from_world @ value
    if name == "points":
        return value.double() @ log.dataset_from_world[:3, :3].T + log.dataset_from_world[:3, 3]
    if isinstance(value, VehiclePath):
        return log.dataset_from_world @ value.poses
    if isinstance(value, BodyPoses):
        joints = quat.to_matrix(value.rotations[value.valid].double())
        joints[:, 0] = log.dataset_from_world[:3, :3] @ joints[:, 0]
        return torch.cat([joints.flatten(), value.valid.double(), value.shape.double()])
    return value


def differences(log: DrivingLog, back: DrivingLog) -> set[str]:
    """Names of all fields of the log, its images, cameras, sweeps and objects that are not as they were."""
    pairs: list[tuple[Any, Any]] = [(log, back)]
    for one, other in zip(log.frames, back.frames, strict=True):
        pairs += [(one, other), (one.camera, other.camera)]
    pairs += list(zip(log.sweeps.gray(), back.sweeps.where(lambda index: index in log.sweeps.indices).gray(),
                      strict=True))  # fmt: skip
    kept = [one for one in log.tracks if one.class_name != "BOLLARD"]
    keys = {one.name: str(number) for number, one in enumerate(kept)}
    found = {one.name: one for one in back.tracks}
    common = [(one, found.get(one.name, found.get(keys[one.name]))) for one in kept]
    pairs += [pair for pair in common if pair[1] is not None]
    lost = set() if len(log.tracks) == len(back.tracks) else {"tracks"}
    lost |= set() if log.sweeps.indices == back.sweeps.indices else {"sweeps"}
    for one, other in pairs:
        for field in dataclasses.fields(one):
            name = field.name
            if name in DERIVED | {"tracks", "sweeps"} or (name == "name" and isinstance(one, DrivingLog)):
                continue
            before, after = (
                in_dataset(of, name, getattr(of_what, name)) for of, of_what in ((log, one), (back, other))
            )
            if name in ("sky", "human", "vehicle", "ego") and before is None:
                continue  # then there is a note
            if not same(before, after, 1e-4):
                lost.add(name)
    return lost


def with_frames(log: DrivingLog, change: Any) -> DrivingLog:
    return replace(log, frames=as_frames([change(frame) for frame in log.frames]))


def plain(log: DrivingLog) -> DrivingLog:
    """Without what no flavor has room for, with the names that objects have in a folder."""
    log = with_frames(log, lambda frame: replace(frame, camera=replace(frame.camera, shutter=None, exposure=0.0)))
    numbers = tuple(map(str, NUMBERS["waymo"]))
    tracks = tuple(replace(one, name=str(number)) for number, one in enumerate(log.tracks))
    return replace(log, tracks=tracks, camera_names=numbers)


def late(log: DrivingLog) -> DrivingLog:
    span = image_stamp(4, 1) - int(STAMPS[0])
    return replace(log, tracks=tuple(replace(one, times=one.times + 3e7 / span) for one in log.tracks))


HARD = {
    "as it is": lambda log: log,
    "plain": plain,
    "late boxes": lambda log: late(plain(log)),
    "masks": lambda log: with_frames(plain(log), lambda frame: frame if frame.indices != (2, 1) else replace(
        frame, sky=None, human=None, ego=None)),
    "no sweep": lambda log: replace(log, sweeps=log.sweeps.where(lambda index: index != 2)),
    "extras": lambda log: replace(
        log, sparse_points=lambda: SparsePoints(torch.zeros(7, 3), torch.zeros(7, 3)), truth=lambda view: None),
    "unknown": lambda log: replace(log, tracks=(replace(log.tracks[0], class_name="BOLLARD"), *log.tracks[1:])),
}  # fmt: skip


@FLAVORS
@pytest.mark.parametrize("case", HARD)
def test_every_difference_is_said_and_nothing_else(case, flavor, tmp_path):
    log = HARD[case](crooked(flavor, FEW[flavor]))
    losses = DriveStudioWriter(jpeg_quality=None, flavor=flavor).losses(log)
    written(log, tmp_path / "out", flavor)
    back = DriveStudioReader(tmp_path / "out").read()
    expected = {LOST[name] for name in differences(log, back)}
    assert {line for line in expected if not any(said.startswith(line) for said in losses)} == set()
    assert [said for said in losses if not any(said.startswith(line) for line in expected)] == []
    assert case != "plain" or len(losses) == {"waymo": 2, "nuscenes": 1}[flavor]
