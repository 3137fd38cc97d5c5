"""The part of a scene that is read: frames of a window, cameras, and what the tables say of their files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.motion import PosePath
from sparsestreet.data.nuscenes.choice import find_scene, find_tables
from sparsestreet.data.nuscenes.instants import Instants, Rate, find_instants
from sparsestreet.data.nuscenes.scene import DataFile, SceneFiles, pose_of, read_scene
from sparsestreet.data.nuscenes.tables import Row, rows_of_tokens, rows_where
from sparsestreet.data.window import chosen_cameras, frame_window

_WRONG_POSES = ("scene-0499", "scene-0515", "scene-0517")
"""The nuScenes devkit's README lists them."""


@dataclass(frozen=True)
class Selection:
    """Frames are counted from the window's start, cameras by their places."""

    scene: SceneFiles
    rate: Rate
    instants: Instants
    """Of the whole scene."""
    window: range
    """Instants."""
    cameras: tuple[str, ...]
    """Channels."""
    choice: str
    """Which scene it is, in words."""

    @cached_property
    def images(self) -> dict[tuple[int, int], DataFile]:
        """(frame, camera) -> image, in this order."""
        return {
            (instant - self.window.start, index): self.instants.images[instant, name]
            for instant in self.window
            for index, name in enumerate(self.cameras)
            if (instant, name) in self.instants.images
        }

    @cached_property
    def sweeps(self) -> dict[int, DataFile]:
        """Frame -> sweep."""
        found = self.instants.sweeps
        return {instant - self.window.start: found[instant] for instant in self.window if instant in found}

    def images_of(self, camera: int) -> list[DataFile]:
        return [file for (_, index), file in self.images.items() if index == camera]

    @cached_property
    def annotations(self) -> list[Row]:
        """Boxes of the whole scene: the size of an object does not change with the window."""
        return rows_where(self.scene.tables / "sample_annotation.json", "sample_token", self.scene.places)

    @cached_property
    def egos(self) -> dict[str, Row]:
        """Token -> row of ego_pose, of every file."""
        files = (*self.images.values(), *self.sweeps.values())
        return rows_of_tokens(self.scene.tables / "ego_pose.json", {file.row.text("ego_pose_token") for file in files})

    def world_from_sensor(self, file: DataFile) -> Float64[Tensor, "4 4"]:
        """At the file's own stamp: of an image its own row of ego_pose counts, not the lidar's."""
        ego = self.egos[file.row.text("ego_pose_token")]
        return pose_of(ego) @ pose_of(self.scene.calibrations[file.row.text("calibrated_sensor_token")])

    def vehicle(self) -> PosePath:
        """Where it was at the images of the first camera."""
        files = self.images_of(0) or list(self.images.values())[:1]
        poses = torch.stack([pose_of(self.egos[file.row.text("ego_pose_token")]) for file in files])
        return PosePath(torch.tensor([file.stamp for file in files]), poses)

    def rows(self) -> list[Mapping[str, object]]:
        """What the tables say of the selection, in an order that follows from it."""
        files = [*self.images.values(), *self.sweeps.values()]
        used = {file.row.text("calibrated_sensor_token") for file in files}
        rows = [file.row for file in files]
        rows += [self.egos[file.row.text("ego_pose_token")] for file in files]
        rows += [self.scene.calibrations[token] for token in sorted(used)]
        return [
            row.values for row in (*rows, *self.scene.samples, *sorted(self.annotations, key=lambda row: row.token))
        ]

    def notes(self) -> list[str]:
        """What a user should know of how the scene was read."""
        notes = [self.choice]
        if self.rate == "keyframes":
            others = sum(not file.keyframe for name in self.cameras for file in self.scene.files[name])
            if others:
                notes.append(f"keyframes alone are read, the {others} images between them with data.log.rate=all")
        else:
            samples, instants = len(self.instants.of_samples), len(self.instants.stamps)
            notes.append(
                f"boxes are annotated at {samples} of {instants} instants, and carried on between two with one"
            )
        if self.instants.without_instant:
            notes.append(f"{self.instants.without_instant} images are left out: their instant has a nearer one")
        if absent := len(self.window) * len(self.cameras) - len(self.images):
            notes.append(f"{absent} images are not in the tables, so some instants lack cameras")
        if self.scene.name in _WRONG_POSES:
            notes.append(f"{self.scene.name} is one of the scenes whose poses the publisher calls wrong")
        return notes


def select(
    root: Path,
    *,
    scene: str | int | None,
    version: str | None,
    rate: Rate,
    cameras: Sequence[str] | None,
    first_frame: int,
    last_frame: int,
) -> Selection:
    """Finds the scene and reads what its tables say. Raises LogError for tables that are broken, ValueError for a
    scene, frames or cameras that are not there."""
    tables = find_tables(root, version)
    row, choice = find_scene(tables, scene)
    files = read_scene(root, tables, row)
    instants = find_instants(files, rate)
    window = frame_window(len(instants.stamps), first_frame, last_frame, root)
    selection = Selection(files, rate, instants, window, chosen_cameras(files.cameras, cameras, root), choice)
    if not selection.images:
        raise ValueError(f"none of {', '.join(selection.cameras)} has an image in frames {first_frame} to {last_frame}")
    return selection
