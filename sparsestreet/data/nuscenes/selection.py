"""The part of a scene that is read: frames of a window, cameras, and what the tables say of their files."""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median_low
from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.nuscenes.tables import (
    LIDAR,
    REMEDY,
    DataFile,
    Row,
    SceneFiles,
    all_rows,
    pose_of,
    read_scene,
    rows_of_tokens,
    rows_where,
)
from sparsestreet.data.poses import PosePath
from sparsestreet.data.problems import fault
from sparsestreet.data.reader import chosen_cameras, frame_window, listed

_DIGITS = 4
"""Of the number in a scene's name."""


def find_tables(root: Path, version: str | None) -> Path:
    """The folder of tables below ``root``. Raises LogError without one, and ValueError where one must be named."""
    found = sorted(path.parent for path in root.glob("*/sample_data.json"))
    names = listed([path.name for path in found])
    if version is not None:
        if not (root / version / "sample_data.json").is_file():
            there = f"there are tables of {names}"
            raise ValueError(f"data.log.version={version}: {root / version} holds no sample_data.json; {there}")
        return root / version
    if not found:
        if (root / "sample_data.json").is_file():
            raise fault(
                root, "this is the folder of the tables", f"name the one above, that holds samples/: {root.parent}"
            )
        here = "the folder holds no */sample_data.json" if root.is_dir() else "no such folder"
        raise fault(root, here, "name the folder that holds v1.0-mini, v1.0-trainval or v1.0-test beside samples/")
    if len(found) > 1:
        raise ValueError(f"{root} holds the tables of {names}: say which, as data.log.version={found[0].name}")
    return found[0]


def find_scene(tables: Path, scene: str | int | None) -> tuple[Row, str]:
    """A scene by its name or by its place in scene.json, from 0, or the only one; its row, and which it is in words.

    Raises LogError for a broken table, ValueError for a scene that is not there.
    """
    rows = all_rows(tables / "scene.json")
    if not rows:
        raise fault(tables / "scene.json", "the table has no scenes", REMEDY)
    names = [row.text("name") for row in rows]
    place = _place(tables, names, scene)
    said = f"{names[place]} is read, at place {place} of {tables.name}/scene.json"
    if isinstance(scene, int):
        said += f", as data.log.scene={scene} asks (DriveStudio counts so){_other(scene, names)}"
    return rows[place], said


def _place(tables: Path, names: list[str], scene: str | int | None) -> int:
    if scene is None:
        if len(names) == 1:
            return 0
        raise ValueError(
            f"{tables} holds {len(names)} scenes: name one, as data.log.scene={names[0]}; there are {listed(names)}"
        )
    if isinstance(scene, int):
        if 0 <= scene < len(names):
            return scene
        reach = f"a number is a place within 0 to {len(names) - 1} of scene.json"
        raise ValueError(f"data.log.scene={scene}: {reach}{_other(scene, names)}; there are {listed(names)}")
    if scene in names:
        return names.index(scene)
    other = _other(int(scene), names) if scene.isascii() and scene.isdigit() and len(scene) <= _DIGITS else ""
    raise ValueError(f"data.log.scene={scene}: no scene of {tables} has this name{other}; there are {listed(names)}")


def _other(number: int, names: list[str]) -> str:
    """What the number would be in a name."""
    name = f"scene-{number:0{_DIGITS}d}"
    return f"; for the scene whose name has this number say data.log.scene={name}" if name in names else ""


Rate = Literal["keyframes", "all"]
HALF_TURN = 25_000_000
"""Nanoseconds from the middle of a sweep to its stamp, the end of the turn: the lidar turns 20 times a second."""


@dataclass(frozen=True)
class Instants:
    """The instants of a whole scene."""

    stamps: tuple[int, ...]
    """Of each, nanoseconds, increasing."""
    images: Mapping[tuple[int, str], DataFile]
    """(instant, channel) -> image."""
    sweeps: Mapping[int, DataFile]
    """Instant -> sweep."""
    of_samples: Mapping[int, int]
    """Place of a sample -> the instant nearest to it; of two samples with the same instant the nearer one."""
    without_instant: int
    """Images that no instant takes, because it has a nearer one of the same camera."""


def find_instants(scene: SceneFiles, rate: Rate) -> Instants:
    """The samples, or with ``rate="all"`` the images of the front camera."""
    return _keyframes(scene) if rate == "keyframes" else _all_images(scene)


def _keyframes(scene: SceneFiles) -> Instants:
    """A sample is an instant, with the files that it is said to have."""
    found = {(file.sample, name): file for name, files in scene.files.items() for file in files if file.keyframe}
    images = {key: file for key, file in found.items() if key[1] != LIDAR}
    sweeps = {sample: file for (sample, name), file in found.items() if name == LIDAR}
    twins = sum(file.keyframe for files in scene.files.values() for file in files) - len(found)
    return Instants(scene.sample_stamps, images, sweeps, {place: place for place in range(len(scene.samples))}, twins)


def _all_images(scene: SceneFiles) -> Instants:
    """An image of the front camera is an instant; the other cameras fire in turn, each at its own delay.

    Images and samples, less their delay behind the front camera, go to the nearest instant. A sweep goes to the one
    nearest to its middle, when the beam crossed the cameras.
    """
    front = scene.files[scene.cameras[0]]
    stamps = tuple(sorted({file.stamp for file in front}))
    fired = _keyframe_stamps(front)
    images: dict[tuple[int, str], DataFile] = {}
    for camera in scene.cameras:
        files = scene.files[camera]
        taken = _nearest_items(stamps, [file.stamp for file in files], _delay(fired, _keyframe_stamps(files)))
        images |= {(instant, camera): files[item] for instant, item in taken.items()}
    sweeps = scene.files.get(LIDAR, ())
    turned = _nearest_items(stamps, [file.stamp for file in sweeps], HALF_TURN)
    samples = _nearest_items(stamps, scene.sample_stamps, _delay(fired, dict(enumerate(scene.sample_stamps))))
    return Instants(
        stamps,
        images,
        {instant: sweeps[item] for instant, item in turned.items()},
        {sample: instant for instant, sample in samples.items()},
        sum(len(scene.files[camera]) for camera in scene.cameras) - len(images),
    )


def _keyframe_stamps(files: Sequence[DataFile]) -> dict[int, int]:
    """Sample -> the stamp of its file."""
    return {file.sample: file.stamp for file in files if file.keyframe}


def _delay(front: Mapping[int, int], other: Mapping[int, int]) -> int:
    """Nanoseconds that something is later than the front camera: the median of the samples that have both."""
    delays = [stamp - front[sample] for sample, stamp in other.items() if sample in front]
    return median_low(delays) if delays else 0


def _nearest_items(stamps: Sequence[int], items: Sequence[int], delay: int) -> dict[int, int]:
    """Instant -> the nearest of the items that are nearest to it, all ``delay`` earlier than their own stamps."""
    nearest: dict[int, int] = {}
    for item, stamp in enumerate(items):
        instant = _nearest(stamps, stamp - delay)
        held = nearest.get(instant)
        if held is None or abs(stamp - delay - stamps[instant]) < abs(items[held] - delay - stamps[instant]):
            nearest[instant] = item
    return nearest


def _nearest(stamps: Sequence[int], stamp: int) -> int:
    """Place of the nearest of increasing stamps; of two equally near ones the earlier."""
    after = bisect_left(stamps, stamp)
    if after == 0:
        return 0
    if after == len(stamps):
        return after - 1
    return after if stamps[after] - stamp < stamp - stamps[after - 1] else after - 1


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
    """Find the scene and read what its tables say. Raises LogError for tables that are broken, ValueError for a
    scene, frames or cameras that are not there."""
    tables = find_tables(root, version)
    row, choice = find_scene(tables, scene)
    files = read_scene(root, tables, row)
    instants = find_instants(files, rate)
    window = frame_window(len(instants.stamps), first_frame, last_frame, root)
    selection = Selection(files, rate, instants, window, chosen_cameras(files.cameras, cameras, root), choice)
    if blank := [name for index, name in enumerate(selection.cameras) if not selection.images_of(index)]:
        raise ValueError(
            f"frames {first_frame} to {last_frame} hold no image of {', '.join(blank)}: read other frames, or name "
            "cameras that have some (data.log.cameras)"
        )
    return selection
