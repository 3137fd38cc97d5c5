"""From nuScenes' tables and files to a recording of one scene."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar, get_args

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.lidar import sensor_returns
from sparsestreet.data.nuscenes.selection import Rate, Selection, select
from sparsestreet.data.nuscenes.tables import LIDAR, DataFile, Row, SceneFiles, all_rows, pose_of, rows_of_tokens
from sparsestreet.data.poses import check_extent
from sparsestreet.data.problems import LogError, missing_files
from sparsestreet.data.reader import FolderSignature, LogFiles, hash_files
from sparsestreet.data.recorded_images import Pixels, RecordedImage, lowest_rows
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera
from sparsestreet.geometry.cameras import transform_points

_MAX_SIDE = 1 << 14
"""Pixels; genuine images have 1600x900."""
EGO_ROWS = {"CAM_BACK": 80}
"""Channel -> how many of the lowest rows show the recording car (neurad-studio's nuScenes reader)."""
_EGO_ROWS_OF_SCENES = {"scene-0164": {"CAM_BACK": 146}}
_HEIGHT = 900
"""Rows of the images that these are counted in."""


def recorded_size(files: Sequence[DataFile]) -> tuple[int, int]:
    """(width, height) of a camera's images, as sample_data says. Raises LogError where they differ."""
    sizes = [(file.row.count("width", _MAX_SIDE), file.row.count("height", _MAX_SIDE)) for file in files]
    for file, size in zip(files, sizes, strict=True):
        if size != sizes[0] or 0 in size:
            raise file.row.fault("width, height", f"must be positive, and those of the camera, {sizes[0]}", size)
    return sizes[0]


def camera_intrinsics(scene: SceneFiles, name: str, files: Sequence[DataFile]) -> Float64[np.ndarray, "3 3"]:
    """Those of all images of a camera, as the tables have them. Raises LogError where they differ or are broken."""
    intrinsics = [_intrinsics(scene, file) for file in files]
    for file, one in zip(files, intrinsics, strict=True):
        if not np.array_equal(one, intrinsics[0]):
            raise file.row.fault("calibrated_sensor_token", f"must have the intrinsics of all {name}", one.tolist())
    return intrinsics[0]


def _intrinsics(scene: SceneFiles, file: DataFile) -> Float64[np.ndarray, "3 3"]:
    row = scene.calibrations[file.row.text("calibrated_sensor_token")]
    intrinsics = row.numbers("camera_intrinsic", (3, 3))
    pinhole = np.array([[intrinsics[0, 0], 0, intrinsics[0, 2]], [0, intrinsics[1, 1], intrinsics[1, 2]], [0, 0, 1]])
    if not np.array_equal(intrinsics, pinhole) or min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise row.fault(
            "camera_intrinsic", "must be fx 0 cx, 0 fy cy, 0 0 1 with positive fx and fy", intrinsics.tolist()
        )
    return intrinsics


COLUMNS = 5
"""float32: x, y, z in meters, intensity in [0, 255], ring."""
_LARGEST = 100_000_000
"""Bytes; a genuine sweep of 35,000 returns has 0.7 MB."""
OWN_CAR = 2.5
"""Meters from the lidar: nearer returns are of the recording car, or none at all (zeros)."""
_REMEDY = "extract the file again from the data set's archive, or read the log without lidar (data.log.lidar=false)"


def read_sweep(path: Path, world_from_lidar: Float64[Tensor, "4 4"]) -> Float64[Tensor, "n 3"]:
    """Points in nuScenes' world, without those of the recording car.

    The publisher has moved them by the car's own motion to the sweep's stamp. Raises LogError for a broken file.
    """
    return transform_points(world_from_lidar, _street_returns(path)[0])


def read_intensities(path: Path) -> Float[Tensor, " n"]:
    """Those of the points of ``read_sweep``."""
    return _street_returns(path)[1]


def _street_returns(path: Path) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, " n"]]:
    points, intensities = sensor_returns(path, COLUMNS, 255.0, max_bytes=_LARGEST, remedy=_REMEDY)
    others = points.norm(dim=1) >= OWN_CAR
    return points[others], intensities[others]


_LENGTH_WIDTH_HEIGHT = [1, 0, 2]
"""Places in nuScenes' width, length, height."""


def read_boxes(
    scene: SceneFiles, annotations: Sequence[Row], of_samples: Mapping[int, int]
) -> tuple[list[Boxes], tuple[str, ...]]:
    """Every object of the scene that some return hit, with all its boxes; and what should be known of the others.

    A box without returns is one that annotators placed between boxes with returns: the object is hidden there, not
    gone. An object without any return is a guess, and left out. Without lidar nobody can tell, and all are kept.

    Args:
        scene: whose samples the boxes are of.
        annotations: of the scene.
        of_samples: place of a sample -> the frame that its boxes belong to; boxes of other samples are left out.
    """
    objects: dict[str, list[Row]] = {}
    for row in annotations:
        objects.setdefault(row.text("instance_token"), []).append(row)
    without_lidar = LIDAR not in scene.files
    seen = {token: rows for token, rows in objects.items() if without_lidar or any(map(_returns, rows))}
    classes = _classes(scene, seen)
    boxes = [_boxes(scene, token, classes[token], rows, of_samples) for token, rows in seen.items()]
    return boxes, tuple(_notes(scene, seen, len(objects) - len(seen)))


def _returns(row: Row) -> int:
    """Lidar and radar returns in a box."""
    return row.count("num_lidar_pts") + row.count("num_radar_pts")


def _classes(scene: SceneFiles, objects: Mapping[str, object]) -> dict[str, str]:
    """Instance -> the name of its category."""
    instances = rows_of_tokens(scene.tables / "instance.json", set(objects))
    tokens = {row.text("category_token") for row in instances.values()}
    categories = rows_of_tokens(scene.tables / "category.json", tokens)
    return {token: categories[row.text("category_token")].text("name") for token, row in instances.items()}


def _boxes(scene: SceneFiles, token: str, category: str, rows: Sequence[Row], of_samples: Mapping[int, int]) -> Boxes:
    by_sample: dict[int, Row] = {}
    for row in rows:
        place = scene.places[row.text("sample_token")]
        if by_sample.setdefault(place, row) is not row:
            raise row.fault("instance_token", "must have one box a sample", token)
    places = [place for place in sorted(by_sample) if place in of_samples]
    sizes = np.array([_size(by_sample[place]) for place in places]).reshape(-1, 3)
    poses = [pose_of(by_sample[place]).numpy() for place in places]
    return Boxes(
        name=token,
        class_name=category,
        frames=np.array([of_samples[place] for place in places], np.int64),
        poses=np.array(poses).reshape(-1, 4, 4),
        sizes=sizes,
        path=scene.tables / "sample_annotation.json",
        stamps=tuple(scene.sample_stamps[place] for place in places),
    )


def _size(row: Row) -> Float64[np.ndarray, "3"]:
    """Length, width, height, meters."""
    size = row.numbers("size", (3,))
    if not (size > 0).all():
        raise row.fault("size", "must be a positive width, length and height", size.tolist())
    return size[_LENGTH_WIDTH_HEIGHT]


def _notes(scene: SceneFiles, objects: Mapping[str, Sequence[Row]], unseen: int) -> list[str]:
    rows = [row for boxes in objects.values() for row in boxes]
    notes = []
    if unseen:
        notes.append(f"{unseen} objects that no lidar or radar return hit at any keyframe are left out")
    if LIDAR in scene.files and (hidden := sum(not _returns(row) for row in rows)):
        notes.append(f"{hidden} of {len(rows)} boxes hold no return: their objects are hidden then, and are kept")
    names = {row.token: row.text("name") for row in all_rows(scene.tables / "attribute.json")}
    counts = Counter(names.get(token, "?") for row in rows for token in _attributes(row))
    if counts:
        said = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
        notes.append(f"attributes of the boxes are not used, displacement tells what moves: {said}")
    return notes


def _attributes(row: Row) -> list[str]:
    tokens = row.values.get("attribute_tokens")
    if not isinstance(tokens, list) or not all(isinstance(token, str) for token in tokens):
        raise row.fault("attribute_tokens", "must be a list of tokens", tokens)
    return tokens


@dataclass(frozen=True, kw_only=True)
class NuScenesReader(RecordedReader):
    """One scene of the folder that holds ``v1.0-*`` beside ``samples`` and ``sweeps``; ``cameras`` are channels.

    The world is that of the scene's map. Shutters are global, images have no lens. Each image has the pose of its own
    stamp. Lidar points are where they were at the end of a turn. Boxes are those of the samples, at their stamps.
    """

    marks = FolderSignature(("*/sample_data.json",))

    scene: str | int | None = None
    """Its name, as "scene-0061"; or its place in scene.json, from 0, as DriveStudio counts; None: the only one."""
    version: str | None = None
    """Folder of the tables, as "v1.0-mini"; None: the only one."""
    rate: Rate = "keyframes"
    """"keyframes": an instant is a sample, 2 a second; "all": an image of the front camera, 12 a second."""
    principal_shift: float | int = 0.5
    """Pixels of the recorded images that are added to cx and cy, because here pixel centers are at +0.5. 0 for tables
    whose numbers are counted so already."""

    first_pose_of: ClassVar[str] = "camera"

    def __post_init__(self) -> None:
        super().__post_init__()
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
        if problems := self.given.check((rig[shot.camera].name, shot.stem) for shot in shots):
            raise LogError(problems)
        boxes, notes = self._boxes()
        if far := check_extent(_placed(shots, boxes or ())):
            raise LogError(far)
        sizes = [recorded_size(chosen.images_of(camera.index)) for camera in rig]
        rows = EGO_ROWS | _EGO_ROWS_OF_SCENES.get(chosen.scene.name, {})
        ego = lowest_rows(rig, {name: (count, _HEIGHT) for name, count in rows.items()})
        pixels = Pixels(rig, sizes, self.given, ego, "sample_data.json says")
        return Recording(
            name=chosen.scene.name,
            rig=rig,
            shots=shots,
            read_image=pixels.image,
            read_masks=pixels.masks,
            mask_kinds=self.given.beside(["ego"] if rows.keys() & set(chosen.cameras) else ()),
            # Behind the last image there are no frames.
            frame_stamps=tuple(chosen.instants.stamps[instant] for instant in chosen.window)[: 1 + shots[-1].frame],
            sweeps=self._sweeps(),
            boxes=boxes,
            annotated=frozenset(instant - chosen.window.start for instant in chosen.instants.of_samples.values()),
            vehicle=chosen.vehicle(),
            notes=(*chosen.notes(), *notes),
        )

    def files(self) -> LogFiles:
        """Images and sweeps; ``data_hash`` adds the rows of the tables, which are those of many scenes."""
        chosen = self._selection
        return LogFiles(recorded=[file.path for file in (*chosen.images.values(), *chosen.sweeps.values())])

    def data_hash(self) -> str:
        """Equal for the same scene in other tables too, as those of v1.0-mini and v1.0-trainval."""
        rows = json.dumps(self._selection.rows(), sort_keys=True)
        return hashlib.sha256(f"{hash_files(self.folder, self.files())}\n{rows}".encode()).hexdigest()[:12]

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
        """Pinholes: the publisher has taken the lens out of the images."""
        chosen, rig = self._selection, []
        for index, name in enumerate(chosen.cameras):
            files = chosen.images_of(index)
            intrinsics = torch.from_numpy(camera_intrinsics(chosen.scene, name, files).copy())
            intrinsics[:2, 2] += self.principal_shift
            rig.append(self.pinhole(name, index, intrinsics, recorded_size(files)))
        return rig

    def _sweeps(self) -> dict[int, LidarSweep] | None:
        """None: there is no lidar, or it is not wanted."""
        chosen = self._selection
        if not self.lidar or LIDAR not in chosen.scene.files:
            return None
        poses = {frame: chosen.world_from_sensor(file) for frame, file in chosen.sweeps.items()}
        return {
            frame: LidarSweep(
                partial(read_sweep, file.path, poses[frame]),
                file.stamp,
                poses[frame][:3, 3],
                partial(read_intensities, file.path),
            )
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
