"""Make a street on disk: render and write all frames with their errors of poses, or nothing."""

import dataclasses
import hashlib
import json
import os
import shutil
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float64, Int16
from scipy.spatial.transform import Rotation

from sparsestreet.data.drivestudio.bodies import blank_person, pickled_people, set_pose
from sparsestreet.data.images import jpeg, mask_png
from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic.capture import street_camera
from sparsestreet.data.synthetic.models import Pedestrian
from sparsestreet.data.synthetic.render import StreetFrame, StreetImage, hood_coverage, render_frame
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.textures import stream
from sparsestreet.data.synthetic.tracer import Point, Pose, at
from sparsestreet.data.synthetic.world import Actor, World, build_world
from sparsestreet.geometry.skeleton import JOINTS, NUM_JOINTS, rest_joints
from sparsestreet.types import Shutter, Track, View


def noisy_camera(settings: StreetSettings, world_from_camera: Pose, frame: int, camera: int) -> Pose:
    """Return the pose that the files say an image has: the true one and a random rigid motion of its own."""
    if not settings.pose_noise:
        return world_from_camera
    meters, degrees = settings.pose_noise
    drawn = stream(settings.seed, f"pose of {frame} {camera}").standard_normal((2, 3)) / np.sqrt(3)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * drawn[0]).as_matrix()
    motion[:3, 3] = meters * drawn[1]
    return world_from_camera @ motion


def noisy_box(settings: StreetSettings, world_from_object: Pose, name: str, frame: int) -> Pose:
    """Return the pose that the files say a box has. It stays upright, as people draw boxes."""
    if not settings.box_noise:
        return world_from_object
    meters, degrees = settings.box_noise
    turn, *shift = stream(settings.seed, f"box of {name} {frame}").standard_normal(4)
    x, y, z = (meters * float(value) / np.sqrt(3) for value in shift)
    return world_from_object @ at(x, y, z, float(np.radians(degrees) * turn))


_BOX_FROM_BODY = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Columns are a body's x (left), y (up), z (forward) in box axes (x forward, y left, z up)."""
_TOE = (0.13, 0.0, -0.01)
"""Vector from the foot of a pedestrian to its toe, in the box frame, meters."""


def joint_rotations(person: Pedestrian, traveled: float) -> Float64[np.ndarray, "24 3 3"]:
    """Return the rotations of the joints after ``traveled`` meters: box_from_body, then each relative to its parent.

    Limbs point in the directions of the rendered person's limbs, by the shortest turn. The trunk and the hands are at
    rest.
    """
    rotations = np.tile(np.eye(3), (NUM_JOINTS, 1, 1))
    rotations[0] = _BOX_FROM_BODY
    for side, name in ((1, "left"), (-1, "right")):
        hip, knee, foot = person.leg(side, traveled)
        toe = (foot[0] + _TOE[0], foot[1] + _TOE[1], foot[2] + _TOE[2])
        _point(rotations, [f"{name}_{joint}" for joint in ("hip", "knee", "ankle", "foot")], (hip, knee, foot, toe))
        _point(rotations, [f"{name}_{joint}" for joint in ("shoulder", "elbow", "wrist")], person.arm(side, traveled))
    return rotations


def _point(rotations: Float64[np.ndarray, "24 3 3"], chain: list[str], places: tuple[Point, ...]) -> None:
    """Turn the joints of a chain with its root at rest, so that the limbs point along ``places``."""
    joints = [JOINTS.index(name) for name in chain]
    bones = np.diff(rest_joints().double().numpy()[joints], axis=0)
    wanted = np.diff(np.array(places), axis=0) @ _BOX_FROM_BODY
    turned = np.eye(3)
    for joint, bone, direction in zip(joints, bones, wanted, strict=False):
        rotations[joint] = _shortest_turn(bone, turned.T @ direction)
        turned = turned @ rotations[joint]


def _shortest_turn(start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation by less than half a turn that takes one direction to another."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, a @ b)
    return Rotation.from_rotvec(axis * (angle / sine if sine > 0 else 1.0)).as_matrix()


MINIMUM_PIXELS = 6
"""A person has a pose in a frame only if a camera sees it with at least this many pixels."""


@dataclass
class BodyWriter:
    """Collects the poses of annotated pedestrians with noise, from the camera that sees most of each person."""

    settings: StreetSettings
    world: World
    _people: dict[int, dict[str, Any]] = field(default_factory=dict)
    """Instance id -> its data under DriveStudio's names."""

    def record(self, key: int, actor: int, frame: StreetFrame) -> None:
        """Record the pose of an actor in a frame if it is a visible pedestrian; ``key`` is its instance id."""
        person = self.world.actors[actor]
        pixels = [np.count_nonzero(image.object_indices == actor) for image in frame.images]
        camera = int(np.argmax(pixels))
        if not isinstance(person.model, Pedestrian) or pixels[camera] < MINIMUM_PIXELS:
            return
        rotations = joint_rotations(person.model, person.path.traveled(frame.index / self.settings.frame_rate))
        rng = stream(self.settings.seed, f"body of {person.name} {frame.index}")
        # The setting is the root mean square of the angle, which is the length of three components.
        spread = np.radians(self.settings.body_pose_noise) / np.sqrt(3)
        rotations = rotations @ Rotation.from_rotvec(spread * rng.standard_normal((NUM_JOINTS, 3))).as_matrix()
        world_from_camera = frame.images[camera].camera.world_from_camera[:3, :3]
        rotations[0] = world_from_camera.T @ frame.actor_poses[actor][:3, :3] @ rotations[0]
        stored = self._people.setdefault(key, blank_person(self.settings.num_frames))
        set_pose(stored, frame.index, rotations, camera)

    def write(self, path: Path) -> None:
        """Write the file if anybody was seen."""
        if self._people:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickled_people(self._people))


_FILE = "cameras.json"
AnyView = TypeVar("AnyView", bound=View)


def write_declared(settings: StreetSettings, world: World, root: Path) -> None:
    """Write the file if the settings have something to declare, and let it be known."""
    said: dict[str, Any] = {}
    if settings.readout and settings.readout_known:
        cameras, frames = range(settings.num_cameras), range(settings.num_frames)
        motion = [[_motion(settings, world, frame, camera) for frame in frames] for camera in cameras]
        said |= {"readout": settings.readout, "direction": settings.readout_direction, "motion": motion}
    if settings.shutter_time and settings.shutter_time_known:
        said["exposure"] = settings.shutter_time
    if said:
        (root / _FILE).write_text(json.dumps(said))


def with_declared(log: DrivingLog, settings: StreetSettings, root: Path) -> DrivingLog:
    """Return the log whose views have what the street's file declares; the log itself if there is none."""
    path = root / _FILE
    if not path.is_file():
        return log
    said = json.loads(path.read_text())
    first, last = settings.recorded

    def shutter(frame: int, camera: int) -> Shutter:
        numbers, seconds = torch.tensor(said["motion"][camera][frame]), said["readout"]
        span = seconds / (last - first) if last > first else 0.0
        return Shutter(numbers[:3], numbers[3:], said["direction"], seconds, span)

    def told(view: AnyView) -> AnyView:
        read = shutter(*view.indices) if "readout" in said else None
        return replace(view, camera=replace(view.camera, shutter=read, exposure=said.get("exposure", 0.0)))

    def all_told(frames: Frames) -> Frames:
        return Frames(map(told, frames.views), lambda view: told(frames.load(view)))

    def carried_by(tracks: Sequence[Track], held_out: frozenset[int]) -> tuple[Frames, Sweeps]:
        kept = log.with_tracks(tracks).holding_out(held_out)
        return all_told(kept.frames), kept.sweeps

    return replace(log, frames=all_told(log.frames), carried_by=carried_by)


def _motion(settings: StreetSettings, world: World, frame: int, camera: int) -> list[float]:
    """Return translation (meters) and rotation vector (radians) over the readout, as ``Shutter`` has them."""
    middle = settings.image_time(frame, camera)
    times = (middle - settings.readout / 2, middle, middle + settings.readout / 2)
    start, pose, end = (street_camera(settings, camera, world.ego.pose(time)).world_from_camera for time in times)
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    return np.concatenate((pose[:3, :3].T @ (end[:3, 3] - start[:3, 3]), pose[:3, :3].T @ turn)).tolist()


MINIMUM_RETURNS = 3
"""Least number of lidar returns on an annotated object; ``MINIMUM_PIXELS`` over all cameras suffice too."""

HUMAN_CLASSES = ("Pedestrian", "Cyclist")
VEHICLE_CLASSES = ("Vehicle",)


@dataclass
class StreetWriter:
    """Writes frames in order, and numbers instances in order of first appearance."""

    root: Path
    settings: StreetSettings
    world: World
    _bodies: BodyWriter = field(init=False)
    _ids: dict[int, int] = field(default_factory=dict)
    """Position of an actor in the world -> its id, for actors annotated so far."""
    _instances: dict[str, dict] = field(default_factory=dict)
    _frames: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._bodies = BodyWriter(self.settings, self.world)

    def write_frame(self, frame: StreetFrame) -> None:
        if not self.settings.delays_known:
            frame = replace(frame, images=tuple(self._claimed(frame, number) for number in range(len(frame.images))))
        annotated = self._annotate(frame)
        for camera, image in enumerate(frame.images):
            self._write_image(image, frame.index, camera, annotated)
            if frame.index == 0:
                self._write_intrinsics(image, camera)
        frame.sweep.points.tofile(self._file("lidar", f"{frame.index:03d}.bin"))
        np.savetxt(self._file("lidar_pose", f"{frame.index:03d}.txt"), frame.sweep.world_from_lidar)

    def finish(self) -> None:
        """Write the files about the whole drive."""
        self._file("instances", "instances_info.json").write_text(json.dumps(self._instances, indent=1))
        self._file("instances", "frame_instances.json").write_text(json.dumps(self._frames, indent=1))
        write_declared(self.settings, self.world, self.root)
        self._write_hood()
        self._bodies.write(self.root / "humanpose" / "smpl.pkl")
        frames = range(self.settings.num_frames)
        times = np.arange(self.settings.num_frames) / self.settings.frame_rate
        np.savetxt(self.root / "timestamps.txt", times, fmt="%.9f")
        if self.settings.delays and self.settings.delays_known:
            for camera in range(self.settings.num_cameras):
                own = [self.settings.image_time(frame, camera) for frame in frames]
                np.savetxt(self.root / f"timestamps_{camera}.txt", own, fmt="%.9f")

    def _write_hood(self) -> None:
        for camera in range(self.settings.num_cameras if self.settings.hood_known else 0):
            coverage = hood_coverage(self.settings, camera)
            if coverage is not None:
                self._file("ego_masks", f"{camera}.png").write_bytes(mask_png(coverage > 0))

    def _claimed(self, frame: StreetFrame, camera: int) -> StreetImage:
        """The image with the pose that its camera has at the frame's instant."""
        return replace(frame.images[camera], camera=street_camera(self.settings, camera, frame.world_from_ego))

    def _file(self, folder: str, name: str) -> Path:
        (self.root / folder).mkdir(parents=True, exist_ok=True)
        return self.root / folder / name

    def _annotate(self, frame: StreetFrame) -> list[int]:
        """Record the boxes of this frame and return the annotated actors."""
        actors = self.world.actors
        pixels = sum(_count(image.object_indices, len(actors)) for image in frame.images)
        returns = _count(frame.sweep.object_indices, len(actors))
        seen = (pixels >= MINIMUM_PIXELS) | (returns >= MINIMUM_RETURNS)
        ego = frame.world_from_ego[:2, 3]
        annotated = [
            index
            for index, pose in enumerate(frame.actor_poses)
            if seen[index] and np.linalg.norm(pose[:2, 3] - ego) <= self.settings.annotation_range
        ]
        for index in annotated:
            self._record(index, actors[index], frame.index, frame.actor_poses[index])
            self._bodies.record(self._ids[index], index, frame)
        self._frames[str(frame.index)] = [self._ids[index] for index in annotated]
        return annotated

    def _record(self, index: int, actor: Actor, frame: int, pose: Pose) -> None:
        key = str(self._ids.setdefault(index, len(self._ids)))
        empty = {"frame_idx": [], "obj_to_world": [], "box_size": []}
        blank = {"id": actor.name, "class_name": actor.model.class_name, "frame_annotations": empty}
        notes = self._instances.setdefault(key, blank)["frame_annotations"]
        notes["frame_idx"].append(frame)
        notes["obj_to_world"].append(noisy_box(self.settings, pose, actor.name, frame).tolist())
        notes["box_size"].append(list(actor.model.size))

    def _write_image(self, image: StreetImage, frame: int, camera: int, annotated: list[int]) -> None:
        name = f"{frame:03d}_{camera}"
        self._file("images", f"{name}.jpg").write_bytes(jpeg(image.rgb, self.settings.jpeg))
        said = noisy_camera(self.settings, image.camera.world_from_camera, frame, camera)
        np.savetxt(self._file("extrinsics", f"{name}.txt"), said)
        self._file("sky_masks", f"{name}.png").write_bytes(mask_png(image.sky))
        classes = {index: self.world.actors[index].model.class_name for index in annotated}
        for folder, members in (
            ("all", HUMAN_CLASSES + VEHICLE_CLASSES), ("human", HUMAN_CLASSES), ("vehicle", VEHICLE_CLASSES),
        ):  # fmt: skip
            chosen = [index for index, class_name in classes.items() if class_name in members]
            mask = np.isin(image.object_indices, np.array(chosen, np.int16))
            self._file(f"dynamic_masks/{folder}", f"{name}.png").write_bytes(mask_png(mask))
        ids = np.full(len(self.world.actors) + 1, -1, np.int16)  # the last entry is that of BACKGROUND = -1
        for index in annotated:
            ids[index] = self._ids[index]
        truth = self._file("depth", f"{name}.npz")
        np.savez_compressed(truth, depth=image.depth, instance=ids[image.object_indices])

    def _write_intrinsics(self, image: StreetImage, camera: int) -> None:
        k = image.camera.intrinsics
        values = [k[0, 0], k[1, 1], k[0, 2], k[1, 2], *(image.camera.distortion or (0.0,) * 5)]
        np.savetxt(self._file("intrinsics", f"{camera}.txt"), values)


def _count(indices: Int16[np.ndarray, "..."], actors: int) -> np.ndarray:
    """Return how often each actor's index occurs."""
    return np.bincount(indices[indices >= 0], minlength=actors)


GENERATOR = 3
"""Version of the generator; raised whenever equal settings would give another street."""
MAX_WORKERS = 16
"""Frames that are traced at once, at most: one of 960x640 with three cameras takes 0.4 GB and 10 s of a core."""
_LATER = frozenset(
    {
        "delays", "delays_known", "exposure_walk", "white_balance", "pose_noise", "box_noise", "readout",
        "readout_direction", "readout_known", "shutter_time", "shutter_time_known", "hood", "hood_cameras",
        "hood_known", "tunnel", "jpeg", "limp", "num_crossing", "dirt", "night", "turn",
    }
)  # fmt: skip
"""Settings that came after ``GENERATOR``; at their defaults a street is as it was without them."""


def make_street(settings: StreetSettings, root: Path, progress: Callable[[int, int], None] | None = None) -> Path:
    """Write the street that ``settings`` describe to ``root`` (DriveStudio's layout) and return ``root``.

    An existing street of the same settings is kept. The street is written next to ``root`` and renamed when complete,
    so an interruption leaves nothing. ``progress`` is called with the number of finished frames and of all frames.

    Raises FileExistsError if ``root`` holds anything else.
    """
    root = Path(root)
    if _holds_street(root, settings):
        return root
    partial = root.parent / f".{root.name}.{uuid.uuid4().hex[:8]}.partial"
    partial.mkdir(parents=True)
    try:
        _write(settings, partial, progress)
        try:
            os.rename(partial, root)
        except OSError:
            # Another process may have finished the same street meanwhile; anything else in the way is an error.
            if not _holds_street(root, settings):
                raise
    finally:
        if partial.exists():
            shutil.rmtree(partial)
    return root


def street_name(settings: StreetSettings) -> str:
    """Return a folder's name for the street: its size, a hash of all settings but the seed, and the seed.

    >>> street_name(StreetSettings(num_frames=5, seed=7)).startswith("320x192x5_")
    True
    """
    label = _label(settings)
    label["settings"].pop("seed")
    digest = hashlib.sha256(json.dumps(label, sort_keys=True).encode()).hexdigest()[:8]
    return f"{settings.width}x{settings.height}x{settings.num_frames}_{digest}_seed{settings.seed}"


def _holds_street(root: Path, settings: StreetSettings) -> bool:
    """Whether ``root`` holds this very street; False if nothing is there yet."""
    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return False
    label = root / "street.json"
    if label.is_file() and json.loads(label.read_text()) == _label(settings):
        return True
    raise FileExistsError(
        f"{root} must be free or hold the street of exactly these settings, but it holds something else: "
        "choose another folder or remove this one"
    )


def _label(settings: StreetSettings) -> dict:
    """Return the content of street.json, converted by JSON so that tuples compare as the lists they become."""
    # Streets without an effect keep the name that they had before streets could have it.
    usual = {field.name: field.default for field in dataclasses.fields(settings) if field.name in _LATER}
    said = {name: value for name, value in dataclasses.asdict(settings).items() if value != usual.get(name, ...)}
    return json.loads(json.dumps({"generator": GENERATOR, "settings": said}))


def _write(settings: StreetSettings, folder: Path, progress: Callable[[int, int], None] | None) -> None:
    world = build_world(settings)
    writer = StreetWriter(folder, settings, world)
    for done, frame in enumerate(_frames(settings, world), start=1):
        writer.write_frame(frame)
        if progress is not None:
            progress(done, settings.num_frames)
    writer.finish()
    (folder / "street.json").write_text(json.dumps(_label(settings), indent=1))


def _frames(settings: StreetSettings, world: World) -> Iterator[StreetFrame]:
    """Yield all frames in order, rendered by threads, because NumPy releases the interpreter while it computes."""
    pending: deque[Future[StreetFrame]] = deque()
    workers = max(2, min(MAX_WORKERS, torch.get_num_threads()))
    executor = ThreadPoolExecutor(workers)
    try:
        for index in range(settings.num_frames):
            pending.append(executor.submit(render_frame, settings, world, index))
            # Render few frames ahead of the writer, so that a long street does not fill the memory.
            if len(pending) > workers + 1:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        executor.shutdown(cancel_futures=True)
