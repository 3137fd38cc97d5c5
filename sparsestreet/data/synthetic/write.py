"""Writes frames of a street in DriveStudio's processed layout (nuScenes flavor), together with the exact truth."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int16

from sparsestreet.data.encoded import jpeg, mask_png
from sparsestreet.data.synthetic.bodies import BodyWriter
from sparsestreet.data.synthetic.cameras import street_camera
from sparsestreet.data.synthetic.declared import write_declared
from sparsestreet.data.synthetic.errors import noisy_box, noisy_camera
from sparsestreet.data.synthetic.hood import hood_coverage
from sparsestreet.data.synthetic.parts import Pose
from sparsestreet.data.synthetic.render import StreetFrame, StreetImage
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import Actor, World

MINIMUM_PIXELS = 6
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
        self._bodies = BodyWriter(self.settings, self.world, MINIMUM_PIXELS)

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
        """Writes the files about the whole drive."""
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
        """Records the boxes of this frame and returns the annotated actors."""
        actors = self.world.actors
        pixels, returns = np.zeros(len(actors), int), np.zeros(len(actors), int)
        for image in frame.images:
            pixels += _count(image.object_indices, len(actors))
        returns += _count(frame.sweep.object_indices, len(actors))
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
    """Returns how often each actor's index occurs."""
    return np.bincount(indices[indices >= 0], minlength=actors)
