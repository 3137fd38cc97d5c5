"""From nuScenes' tables and files to a recording of one scene."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from sparsestreet.data.extent import check_extent
from sparsestreet.data.fingerprint import LogFiles, hash_files
from sparsestreet.data.given_masks import GivenMasks
from sparsestreet.data.images import check_camera_images
from sparsestreet.data.marks import Marks
from sparsestreet.data.nuscenes.boxes import read_boxes
from sparsestreet.data.nuscenes.cameras import nuscenes_camera, recorded_size
from sparsestreet.data.nuscenes.instants import Rate
from sparsestreet.data.nuscenes.pixels import ScenePixels, check_size
from sparsestreet.data.nuscenes.scene import LIDAR
from sparsestreet.data.nuscenes.selection import Selection, select
from sparsestreet.data.nuscenes.sweeps import read_sweep
from sparsestreet.data.problems import LogError, Problem, attempt, missing_files
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedImage, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera


@dataclass(frozen=True, kw_only=True)
class NuScenesReader(RecordedReader):
    """One scene of the folder that holds ``v1.0-*`` beside ``samples`` and ``sweeps``; ``cameras`` are channels.

    The world is that of the scene's map. Shutters are global, images have no lens. Each image has the pose of its own
    stamp. Lidar points are where they were at the end of a turn. Boxes are those of the samples, at their stamps.
    """

    marks = Marks(("*/sample_data.json",))

    scene: str | int | None = None
    """Its name, as "scene-0061"; or its place in scene.json, from 0, as DriveStudio counts; None: the only one."""
    version: str | None = None
    """Folder of the tables, as "v1.0-mini"; None: the only one."""
    rate: Rate = "keyframes"
    """"keyframes": an instant is a sample, 2 a second; "all": an image of the front camera, 12 a second."""
    principal_shift: float | int = 0.5
    """Pixels of the recorded images that are added to cx and cy, because here pixel centers are at +0.5. 0 for tables
    whose numbers are counted so already."""

    def __post_init__(self) -> None:
        if self.rate not in get_args(Rate):
            raise ValueError(f"rate must be one of {', '.join(get_args(Rate))}, got {self.rate!r}")
        if isinstance(self.scene, bool):
            raise ValueError(f"scene must be a name or a place, got {self.scene}")

    def recording(self) -> Recording:
        chosen = self._selection
        files = [*chosen.images.values(), *(chosen.sweeps.values() if self.lidar else ())]
        if problems := missing_files(file.path for file in files):
            raise LogError(problems)
        rig, shots = self._rig(), _shots(chosen)
        if self._given is not None and (
            problems := self._given.check((rig[shot.camera].name, shot.stem) for shot in shots)
        ):
            raise LogError(problems)
        boxes, notes = self._boxes()
        if far := check_extent(_placed(shots, boxes or ())):
            raise LogError(far)
        sizes = [recorded_size(chosen.images_of(camera.index)) for camera in rig]
        pixels = ScenePixels(rig, sizes, chosen.scene.name, self._given)
        return Recording(
            name=chosen.scene.name,
            rig=rig,
            shots=shots,
            read_image=pixels.image,
            read_masks=pixels.masks,
            mask_kinds=pixels.mask_kinds,
            # Behind the last image there are no frames.
            frame_stamps=tuple(chosen.instants.stamps[instant] for instant in chosen.window)[: 1 + shots[-1].frame],
            sweeps=self._sweeps(),
            boxes=boxes,
            annotated=frozenset(instant - chosen.window.start for instant in chosen.instants.of_samples.values()),
            vehicle=chosen.vehicle(),
            notes=(*chosen.notes(), *notes),
        )

    def check_contents(self) -> list[Problem]:
        chosen, problems = self._selection, []
        for index, name in enumerate(chosen.cameras):
            images = chosen.images_of(index)
            for file in images:
                attempt(problems, partial(check_size, file.path, recorded_size(images)))
            wrong = {problem.path for problem in problems}
            sound = [file.path for file in images if file.path not in wrong]
            problems += check_camera_images(name, sound, (), decode=True)
        if self._given is not None:
            recording = self.recording()
            for shot in recording.shots:
                attempt(problems, partial(recording.read_masks, shot))
        for sweep in (self._sweeps() or {}).values():
            attempt(problems, sweep.read)
        return problems

    def files(self) -> LogFiles:
        """Images and sweeps; ``data_hash`` adds the rows of the tables, which are those of many scenes."""
        chosen = self._selection
        return LogFiles(recorded=[file.path for file in (*chosen.images.values(), *chosen.sweeps.values())])

    def data_hash(self) -> str:
        """Equal for the same scene in other tables too, as those of v1.0-mini and v1.0-trainval."""
        rows = json.dumps(self._selection.rows(), sort_keys=True)
        return hashlib.sha256(f"{hash_files(self.folder, self.files())}\n{rows}".encode()).hexdigest()[:12]

    @property
    def _given(self) -> GivenMasks | None:
        return None if self.masks is None else GivenMasks(Path(self.masks))

    @cached_property
    def _selection(self) -> Selection:
        """Tables of all scenes are large, so they are searched once."""
        return select(
            self.folder,
            scene=self.scene,
            version=self.version,
            rate=self.rate,
            cameras=self.cameras,
            first_frame=self.first_frame,
            last_frame=self.last_frame,
        )

    def _rig(self) -> list[RigCamera[str]]:
        chosen = self._selection
        return [
            nuscenes_camera(
                chosen.scene,
                name,
                index,
                chosen.images_of(index),
                width=self.width,
                principal_shift=self.principal_shift,
            )
            for index, name in enumerate(chosen.cameras)
        ]

    def _sweeps(self) -> dict[int, LidarSweep] | None:
        """None: there is no lidar, or it is not wanted."""
        chosen = self._selection
        if not self.lidar or LIDAR not in chosen.scene.files:
            return None
        return {
            frame: LidarSweep(partial(read_sweep, file.path, chosen.world_from_sensor(file)), file.stamp)
            for frame, file in chosen.sweeps.items()
        }

    def _boxes(self) -> tuple[list[Boxes] | None, tuple[str, ...]]:
        """None: nothing is annotated, as in v1.0-test."""
        chosen = self._selection
        if not chosen.annotations:
            return None, ()
        frames = {sample: instant - chosen.window.start for sample, instant in chosen.instants.of_samples.items()}
        return read_boxes(chosen.scene, chosen.annotations, frames)


def _shots(chosen: Selection) -> list[RecordedImage]:
    return [
        RecordedImage(
            frame=frame,
            camera=camera,
            world_from_camera=chosen.world_from_sensor(file),
            key=file.path,
            stem=file.path.stem,
            stamp=file.stamp,
        )
        for (frame, camera), file in chosen.images.items()
    ]


def _placed(shots: Sequence[RecordedImage], boxes: Sequence[Boxes]) -> list[tuple[Path, Tensor]]:
    placed = [(Path(str(shot.key)), shot.world_from_camera[:3, 3]) for shot in shots]
    return placed + [(box.path, torch.from_numpy(position)) for box in boxes for position in box.poses[:, :3, 3]]
