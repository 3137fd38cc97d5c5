"""From a segment of Waymo's Open Dataset to a recording."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from PIL import Image
from torch import Tensor

from sparsestreet.data.images import GivenMasks, colors
from sparsestreet.data.lidar import check_points, unit_intensities
from sparsestreet.data.poses import PosePath, check_extent
from sparsestreet.data.problems import LogError, Problem, attempt, fault
from sparsestreet.data.reader import FolderSignature, LogFiles, chosen_cameras, frame_window, listed
from sparsestreet.data.recorded_images import RecordedImage
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera, Undistortion, check_lens, rig_camera
from sparsestreet.data.waymo.boxes import camera_at, middle, read_boxes, shutter
from sparsestreet.data.waymo.segment import (
    REMEDY,
    SPIN,
    ImageMotion,
    Segment,
    Spool,
    canonical,
    check_returns,
    world_points,
)
from sparsestreet.data.waymo.v1 import RecordSegment
from sparsestreet.data.waymo.v2 import TableSegment

_COMPONENTS = ("vehicle_pose", "camera_image", "camera_calibration", "lidar", "lidar_box")
_RECORDS = ("*.tfrecord", "*/*.tfrecord", "*/*/*.tfrecord")
_MAX_INDEX = 10**6
"""A number above is no place in a list but a name: Hydra takes the digits and underscores of one for a number."""


def find_segments(root: Path) -> dict[str, Path]:
    """The segments of a folder, by name: files of version 1, or folders of components of version 2.

    Raises LogError for a folder that holds segments of neither version, or of both.
    """
    if not root.is_dir():
        raise fault(root, "there is no such folder", "name the folder that holds Waymo's files (data.root)")
    records = {canonical(path.name): path for pattern in _RECORDS for path in sorted(root.glob(pattern))}
    tables = {
        canonical(path.name): path.parent.parent
        for component in _COMPONENTS
        for pattern in (f"{component}/*.parquet", f"*/{component}/*.parquet")
        for path in sorted(root.glob(pattern))
    }
    if records and tables:
        message = f"it holds {len(records)} segments of version 1 (.tfrecord) and {len(tables)} of version 2 (.parquet)"
        raise fault(root, message, "name the folder of one of them (data.root)")
    if not records and not tables:
        message = "it holds neither *.tfrecord (version 1) nor component/*.parquet (version 2), up to two folders deep"
        raise fault(root, message, "name the folder that holds Waymo's files (data.root)")
    return records or tables


def segment_name(root: Path, scene: str | int | None, scenes: Path | str | None) -> str:
    """Return the name of the wanted segment; no file is opened. Arguments and errors as of ``find_segment``."""
    return _wanted(sorted(find_segments(root)), scene, None if scenes is None else Path(scenes), root)


def find_segment(root: Path, scene: str | int | None, scenes: Path | None) -> Segment:
    """The wanted segment, opened.

    Args:
        root: of the files.
        scene: name of a segment, or its place in ``scenes``, from 0; None: the only one.
        scenes: a file with the name of a segment a line.

    Raises LogError for files at fault, ValueError for a scene that is not there.
    """
    places = find_segments(root)
    name = _wanted(sorted(places), scene, scenes, root)
    return TableSegment(places[name], name) if places[name].is_dir() else RecordSegment(places[name])


def _wanted(names: Sequence[str], scene: str | int | None, scenes: Path | None, root: Path) -> str:
    shown = listed(names)
    if scene is None:
        if len(names) > 1:
            raise ValueError(f"data.log.scene must name one of the segments in {root}: {shown}")
        return names[0]
    if isinstance(scene, int) and scene <= _MAX_INDEX:
        scene = _at_place(scene, scenes, shown)
    if isinstance(scene, int):
        name = next((name for name in names if name.replace("_", "") == str(scene)), str(scene))
    else:
        name = canonical(scene)
    if name not in names:
        raise ValueError(f"segment {name} is not in {root}: data.log.scene must be one of {shown}")
    return name


def _at_place(place: int, scenes: Path | None, shown: str) -> str:
    """The line of a list of names."""
    if scenes is None:
        message = f"data.log.scene={place} is a place in a list of segments: name the list (data.log.scenes)"
        raise ValueError(f"{message}, or one of the segments {shown}")
    try:
        lines = [line for line in scenes.read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise fault(scenes, f"the list cannot be read ({error})", "write the name of a segment a line") from error
    if not 0 <= place < len(lines):
        message = f"data.log.scene={place} is not within the {len(lines)} segments of {scenes}, counted from 0"
        raise ValueError(f"{message}; there are files of {shown}")
    return lines[place]


_KINDS = {"sky": (25,), "human": (6, 7, 9, 10, 11), "vehicle": (2, 3, 4, 5, 8)}
"""Of Waymo's 28 classes: bicycles and motorcycles count as human, as in DriveStudio's masks."""


def decode_image(
    data: bytes, recorded: tuple[int, int], size: tuple[int, int], path: Path, what: str
) -> UInt8[Tensor, "h w 3"]:
    """RGB at ``size``; raises LogError for bytes that are no image of ``recorded`` (width, height)."""
    pixels = _opened(data, recorded, path, what, "RGB")
    return torch.from_numpy(np.array(pixels if size == recorded else pixels.resize(size, Image.Resampling.BILINEAR)))


def decode_masks(
    data: bytes,
    divisor: int,
    recorded: tuple[int, int],
    size: tuple[int, int],
    path: Path,
    what: str,
    undistortion: Undistortion | None = None,
) -> dict[str, Bool[Tensor, "h w"]]:
    """Kind -> mask at ``size``, without the lens if told, from a PNG of class * divisor + instance. Raises as
    ``decode_image``.

    Sky takes the nearest pixel; other masks keep every pixel that an object touches, as those of files do.
    """
    if divisor <= 0:
        raise fault(path, f"{what} has the divisor {divisor}", REMEDY)
    classes = np.array(_opened(data, recorded, path, what, None)).astype(np.int32) // divisor
    masks = {}
    for kind, members in _KINDS.items():
        mask = 255 * np.isin(classes, members, kind="table").astype(np.uint8)
        if size != recorded:
            way = Image.Resampling.NEAREST if kind == "sky" else Image.Resampling.BILINEAR
            mask = np.array(Image.fromarray(mask).resize(size, way))
        masks[kind] = torch.from_numpy((mask if undistortion is None else undistortion(mask)) > 0)
    return masks


def _opened(data: bytes, recorded: tuple[int, int], path: Path, what: str, mode: str | None) -> Image.Image:
    """The size is compared before a pixel is decoded."""
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
            if image.size != recorded:
                found = f"{image.size[0]}x{image.size[1]}"
                raise fault(path, f"{what} is {found}, its calibration is for {recorded[0]}x{recorded[1]}", REMEDY)
            if mode is None and image.mode not in ("I;16", "I", "L"):
                raise fault(path, f"{what} has pixels of the kind {image.mode}, not one number each", REMEDY)
            return image.copy() if mode is None else colors(image, path)
    except LogError:
        raise
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise fault(path, f"{what} cannot be decoded ({error})", REMEDY) from error


_ORDERS = {
    0: "not declared, taken as all pixels at once",
    1: "rows from the top",
    2: "columns from the left",
    3: "rows from below",
    4: "columns from the right",
    5: "all pixels at once",
}


def segment_notes(
    segment: Segment,
    frames: range,
    cameras: Sequence[str],
    shots: Sequence[RecordedImage],
    num_labelled: int,
) -> tuple[str, ...]:
    """One sentence each: the shutter's direction, labels made by hand, and images and sweeps that are missing."""
    notes = [*segment.notes, *_shutters(segment, cameras)]
    if num_labelled:
        notes.append(
            f"{num_labelled} of {len(shots)} images have masks of sky, people and vehicles, which Waymo had drawn by "
            "hand; the others have none"
        )
    lacking = len(frames) * len(cameras) - len(shots)
    if lacking:
        notes.append(
            f"{lacking} of {len(frames) * len(cameras)} images are not in the files: their cameras are left out"
        )
    swept = sum(map(segment.has_returns, frames))
    if 0 < swept < len(frames):
        notes.append(f"{len(frames) - swept} of {len(frames)} frames have no range images: they have no points")
    return tuple(notes)


def _shutters(segment: Segment, cameras: Sequence[str]) -> list[str]:
    found: dict[int, list[str]] = {}
    for name in cameras:
        found.setdefault(segment.cameras[name].direction, []).append(name)
    return [f"cameras {', '.join(names)} are read out so: {_ORDERS[direction]}" for direction, names in found.items()]


_USUAL = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT")
_HALF = SPIN // 2


@dataclass(frozen=True, kw_only=True)
class WaymoReader(RecordedReader):
    """A segment of version 1 (TFRecord) or 2 (parquet), as the files of ``root`` tell; ``cameras`` are Waymo's names.

    The world is Waymo's. An instant is a spin of the lidar TOP, its stamp that of half of the spin, which the pose of
    the frame is of. Each image has the pose and the stamp of the middle of its readout.
    """

    marks = FolderSignature(("*.tfrecord", "vehicle_pose/*.parquet", "camera_image/*.parquet"), depth=2)

    scene: str | int | None = None
    """Name of a segment, or its place in ``scenes``, from 0; None: the only one."""
    scenes: Path | str | None = None
    """A file with the name of a segment a line, such as the list that DriveStudio counts in."""

    def recording(self) -> Recording:
        segment, frames, cameras = self._segment, self._frames, self._cameras
        rig, shots, boxes, notes = self._rig(), *self._placed()
        given = self.given
        if missing := given.check((cameras[shot.camera], shot.stem) for shot in shots):
            raise LogError(missing)
        labelled = segment.labelled & {shot.key for shot in shots if given.root is None}
        # Behind the last image there are no frames.
        seen = frames[: 1 + shots[-1].frame]
        stamps = tuple(_instant(segment, frame) for frame in seen)
        return Recording(
            name=segment.name,
            rig=rig,
            shots=shots,
            read_image=partial(_read_image, segment, rig),
            read_masks=partial(_read_masks, segment, rig, labelled, given),
            mask_kinds=given.beside(("sky", "human", "vehicle") if labelled else ()),
            frame_stamps=stamps,
            vehicle=PosePath(torch.tensor(stamps), torch.stack([segment.world_from_vehicle(frame) for frame in seen])),
            sweeps=self._sweeps() if self.lidar else None,
            boxes=boxes,
            notes=(*segment_notes(segment, frames, cameras, shots, len(labelled)), *notes),
        )

    def _placed(self) -> tuple[list[RecordedImage], list[Boxes] | None, tuple[str, ...]]:
        """Images, boxes, and what has to be said about these. Raises LogError with all that is wrong with them."""
        segment, frames, problems = self._segment, self._frames, []
        motions = {frame: attempt(problems, partial(segment.images, frame)) or {} for frame in frames}
        boxes, notes = None, ()
        if segment.has_boxes:
            boxes, notes = attempt(problems, partial(read_boxes, segment, frames.start)) or (None, ())
        for frame in frames:
            attempt(problems, partial(segment.world_from_vehicle, frame))
        if problems:
            raise LogError(_once(problems))
        shots = _shots(segment, frames, self._cameras, motions)
        if not shots:
            raise fault(segment.image_file, f"there are no images of {', '.join(self._cameras)}", REMEDY)
        cameras = [(segment.image_file, shot.world_from_camera[:3, 3]) for shot in shots]
        objects = [(one.path, torch.from_numpy(place)) for one in boxes or () for place in one.poses[:, :3, 3]]
        if far := check_extent(cameras + objects):
            raise LogError(far)
        return shots, boxes, notes

    def check_contents(self) -> list[Problem]:
        return self._segment.check_files() + super().check_contents()

    def files(self) -> LogFiles:
        """All components of the segment, lidar too where it is not wanted."""
        return self._segment.files()

    @cached_property
    def _segment(self) -> Segment:
        """Tables and places of records are the same for a check and a read."""
        scenes = None if self.scenes is None else Path(self.scenes)
        segment = find_segment(self.folder, self.scene, scenes)
        late = np.flatnonzero(np.diff(np.array(segment.stamps)) <= 0)
        if len(late):
            raise fault(segment.source, f"the stamps of frames {late[0]} and {late[0] + 1} do not increase", REMEDY)
        return segment

    @property
    def _frames(self) -> range:
        return frame_window(len(self._segment.stamps), self.first_frame, self.last_frame, self.folder)

    @property
    def _cameras(self) -> tuple[str, ...]:
        found = list(self._segment.cameras)
        wanted = [name for name in _USUAL if name in found] if self.cameras is None else self.cameras
        return chosen_cameras(found, wanted, self.folder)

    def _rig(self) -> list[RigCamera[str]]:
        rig = []
        for index, name in enumerate(self._cameras):
            calibration = self._segment.cameras[name]
            f_u, f_v, c_u, c_v, *lens = calibration.intrinsic
            # Counted from the left and upper edge of the image, as here: pixel centers are at +0.5.
            intrinsics = torch.tensor([[f_u, 0, c_u], [0, f_v, c_v], [0, 0, 1]], dtype=torch.float64)
            distortion = torch.tensor(lens, dtype=torch.float64)
            check_lens(self._segment.calibration_file, intrinsics, distortion, calibration.size)
            rig.append(
                rig_camera(
                    name,
                    index,
                    intrinsics=intrinsics,
                    distortion=distortion,
                    recorded_size=calibration.size,
                    width=self.width,
                    undistort=self.undistort,
                )
            )
        return rig

    def _sweeps(self) -> dict[int, LidarSweep] | None:
        segment, frames, spool = self._segment, self._frames, Spool()
        top = segment.lidars.get("TOP")
        found = {
            index: LidarSweep(
                partial(_read_points, segment, spool, frame),
                _instant(segment, frame),
                None if top is None else (segment.world_from_vehicle(frame) @ top.vehicle_from_lidar)[:3, 3],
                partial(_read_intensities, segment, spool, frame),
            )
            for index, frame in enumerate(frames)
            if segment.has_returns(frame)
        }
        return found or None


def _instant(segment: Segment, frame: int) -> int:
    return 1000 * segment.stamps[frame] + _HALF


def _shots(
    segment: Segment, frames: range, cameras: Sequence[str], motions: Mapping[int, Mapping[str, ImageMotion]]
) -> list[RecordedImage]:
    shots = []
    for index, frame in enumerate(frames):
        for place, name in enumerate(cameras):
            if name not in motions[frame]:
                continue
            motion, calibration = motions[frame][name], segment.cameras[name]
            stamp = middle(motion)
            shots.append(
                RecordedImage(
                    index,
                    place,
                    camera_at(motion, calibration, stamp),
                    (frame, name),
                    f"{frame:03d}",
                    stamp,
                    shutter(motion, calibration),
                    motion.exposure,
                )
            )
    return shots


def _read_image(segment: Segment, rig: Sequence[RigCamera[str]], shot: RecordedImage) -> UInt8[Tensor, "h w 3"]:
    camera = rig[shot.camera]
    frame = int(shot.stem)
    data, recorded = segment.jpeg(frame, camera.name), segment.cameras[camera.name].size
    what = f"the image of {camera.name} at frame {frame}"
    pixels = decode_image(data, recorded, camera.size, segment.image_file, what)
    return pixels if camera.undistortion is None else torch.from_numpy(camera.undistortion(pixels.numpy()))


def _read_masks(
    segment: Segment,
    rig: Sequence[RigCamera[str]],
    labelled: frozenset[tuple[int, str]],
    given: GivenMasks,
    shot: RecordedImage,
) -> Mapping[str, Bool[Tensor, "h w"]]:
    """Those that somebody made for all images, or else those that Waymo had made for some."""
    camera, frame = rig[shot.camera], int(shot.stem)
    recorded = segment.cameras[camera.name].size
    if (frame, camera.name) not in labelled:
        take_out = camera.undistortion
        return given.read(camera.name, shot.stem, recorded_size=recorded, size=camera.size, undistortion=take_out)
    data, divisor = segment.panoptic(frame, camera.name)
    what = f"the panoptic label of {camera.name} at frame {frame}"
    return decode_masks(data, divisor, recorded, camera.size, segment.label_file, what, camera.undistortion)


def _read_points(segment: Segment, spool: Spool, frame: int) -> Float64[Tensor, "n 3"]:
    """Points of the world."""
    near = _read_rows(segment, spool, frame)[:, :3]
    return torch.from_numpy(near.astype(np.float64)) + segment.world_from_vehicle(frame)[:3, 3]


def _read_intensities(segment: Segment, spool: Spool, frame: int) -> Float[Tensor, " n"]:
    return unit_intensities(_read_rows(segment, spool, frame)[:, 3], brightest=1.0)


def _read_rows(segment: Segment, spool: Spool, frame: int) -> Float32[np.ndarray, "n 4"]:
    """Points from where the vehicle was, as float32 exact to 0.01 mm, and intensities; decoded once."""
    if frame not in spool:
        pose, parts = segment.world_from_vehicle(frame), [np.zeros((0, 4))]
        for returns in segment.returns(frame):
            calibration = check_returns(returns, segment.lidars.get(returns.lidar), segment.lidar_file, frame)
            points, intensities = world_points(returns, calibration, pose)
            parts.append(np.column_stack((points - pose[:3, 3].numpy(), intensities)))
        rows = np.concatenate(parts)
        check_points(torch.from_numpy(rows[:, :3]), segment.lidar_file, remedy=REMEDY)
        spool.put(frame, rows.astype(np.float32).tobytes())
    return np.frombuffer(spool.get(frame), np.float32).reshape(-1, 4)


def _once(problems: Sequence[Problem]) -> list[Problem]:
    """Equal problems said once, in their order."""
    return list(dict.fromkeys(problems))
