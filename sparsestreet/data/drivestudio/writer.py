"""A log in DriveStudio's processed layout."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.convert import LogFile, LogWriter
from sparsestreet.data.drivestudio.annotations import (
    CAMERAS,
    ROUNDING,
    Placement,
    WrittenFlavor,
    boxes_at_frames,
    class_in,
    dataset_from_camera,
    delay_of_boxes,
    frame_instances,
    frame_stamps,
    instances_info,
    object_keys,
    people,
    placed,
    seconds_lines,
    written_tracks,
)
from sparsestreet.data.drivestudio.layout import EGO_MASKS, FINE_MASKS, FOLDER_KINDS, SKY_MASKS, Layout
from sparsestreet.data.images import jpeg, mask_png, number_lines, png
from sparsestreet.data.lazy import Frames, spread
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.poses import AHEAD_FROM_OPENCV
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Frame, View

_LOOKED_AT = 12
"""Images of a camera whose first one has no mask of the recording car."""


@dataclass(frozen=True)
class MaskKinds:
    """What was found in the images of a log."""

    everywhere: tuple[str, ...]
    """Those of FOLDER_KINDS that every image has."""
    lacking: Mapping[str, tuple[int, int]]
    """The other kinds, and frame and camera of the first image without."""
    ego: Mapping[int, Frame]
    """Camera -> a frame with the mask of the recording car that all of its images have."""
    changing_ego: tuple[int, ...]
    """Cameras whose images have different ones."""


@lru_cache(maxsize=1)
def find_masks(frames: Frames) -> MaskKinds:
    """Decode images until no more kind can be in all of them: a few of a log without masks, else all."""
    lacking: dict[str, tuple[int, int]] = {}
    for frame in frames:
        for kind in FOLDER_KINDS:
            if kind not in lacking and getattr(frame, kind) is None:
                lacking[kind] = frame.indices
        if len(lacking) == len(FOLDER_KINDS):
            break
    ego, changing = {}, []
    for camera in sorted({view.indices[1] for view in frames.views}):
        own = frames.where(lambda view, camera=camera: view.camera_index == camera)
        first = own[0]
        others = own if first.ego is not None else own.at(spread(len(own), _LOOKED_AT))
        if not all(_same_ego(first, frame) for frame in others):
            changing.append(camera)
        elif first.ego is not None:
            ego[camera] = first
    everywhere = tuple(kind for kind in FOLDER_KINDS if kind not in lacking)
    return MaskKinds(everywhere, lacking, ego, tuple(changing))


def _same_ego(frame: Frame, other: Frame) -> bool:
    if frame.ego is None or other.ego is None:
        return frame.ego is other.ego
    return torch.equal(frame.ego, other.ego)


_MOVED = 1e-4
"""Meters, and radians: what float32 poses and mounts are off by is less."""
_SIZES = {"waymo": (*[(1920, 1280)] * 3, *[(1920, 866)] * 2), "nuscenes": [(1600, 900)] * 6}
"""Width and height by DriveStudio's number of the camera, which its loaders do not ask the images for."""


def dropped_content(log: DrivingLog, where: Placement) -> tuple[str, ...]:
    """Return what becomes of the log, one sentence each, with numbers."""
    parts: tuple[Callable[[DrivingLog, Placement], Iterator[str]], ...] = (
        _cameras, _images, _shutters, _sweeps, _dropped_masks, _boxes, _objects, _others
    )  # fmt: skip
    return tuple(sentence for part in parts for sentence in part(log, where))


def _cameras(log: DrivingLog, where: Placement) -> Iterator[str]:
    numbers = tuple(map(str, where.cameras))
    if log.camera_names and log.camera_names != numbers:
        names = ", ".join(log.camera_names)
        yield f"names of cameras are lost ({log.num_cameras}): {names} become {', '.join(numbers)}"
    exposed = sorted({view.camera.exposure for view in log.views} - {0.0})
    if exposed:
        yield f"exposure times are lost ({exposed[0] * 1e3:.3g} to {exposed[-1] * 1e3:.3g} ms)"


def _images(log: DrivingLog, where: Placement) -> Iterator[str]:
    """Where poses, and when images were taken."""
    if where.mounts is None:
        if log.vehicle is not None:
            yield "the path of the vehicle is lost: the flavor nuscenes has poses of cameras"
        return
    if log.vehicle is not None and log.vehicle.stamps not in (None, frame_stamps(log)):
        yield (f"{len(log.vehicle.poses)} poses of the vehicle become {log.num_frames}, one at the stamp of each frame")
    own = torch.stack([dataset_from_camera(log, view) for view in log.views])
    apart = (own - where.world_from_camera)[:, :3].abs()
    moved, turned = float((own - where.world_from_camera)[:, :3, 3].norm(dim=1).max()), float(apart[..., :3].max())
    if max(moved, turned) > _MOVED:
        yield (
            "poses of images are lost: the flavor waymo has one of the vehicle a frame, in which cameras are rigid; "
            f"images move by up to {moved:.2g} m, and turn by up to {turned:.2g} rad"
        )
    stamps = frame_stamps(log)
    late = [abs(view.stamp - stamps[view.indices[0]]) for view in log.views if view.stamp is not None and stamps]
    if any(late):
        yield f"stamps of images are lost: they become those of their frames, up to {max(late) / 1e6:.3g} ms away"


def _shutters(log: DrivingLog, where: Placement) -> Iterator[str]:
    rolling = [view for view in log.views if view.camera.shutter is not None]
    if rolling:
        shutters = [view.camera.shutter for view in rolling if view.camera.shutter is not None]
        moved = max(float(shutter.translation.norm()) for shutter in shutters)
        turned = max(float(shutter.rotation.norm()) for shutter in shutters)
        cameras = ", ".join(map(str, sorted({where.cameras[view.indices[1]] for view in rolling})))
        yield (
            f"rolling shutters are lost (cameras {cameras}): while an image is read out, its camera moves by up to "
            f"{moved:.2g} m and turns by up to {turned:.2g} rad"
        )


def _sweeps(log: DrivingLog, where: Placement) -> Iterator[str]:
    if absent := without_sweep(log):
        yield f"{len(absent)} frames without a sweep get an empty one, the first of them frame {absent[0]}"


def without_sweep(log: DrivingLog) -> list[int]:
    """Frames that have none, in a log with sweeps."""
    return sorted(set(range(log.num_frames)) - set(log.sweeps.indices)) if len(log.sweeps) else []


def _dropped_masks(log: DrivingLog, where: Placement) -> Iterator[str]:
    found = find_masks(log.frames)
    for kind, (frame, camera) in found.lacking.items():
        # A note says where the log has no such mask at all (absence_notes).
        if not any(note.startswith(f"no {kind} masks") for note in log.notes):
            yield (
                f"{kind} masks are lost: there must be one for each of the {len(log.views)} images, and that of frame "
                f"{frame}, camera {where.cameras[camera]} has none"
            )
    if found.changing_ego:
        cameras = ", ".join(str(where.cameras[camera]) for camera in found.changing_ego)
        yield f"masks of the recording car are lost (cameras {cameras}): there is one a camera, and theirs change"


def _boxes(log: DrivingLog, where: Placement) -> Iterator[str]:
    tracks = written_tracks(log, where.flavor.name)
    late = {track.name: delay for track in tracks if (delay := delay_of_boxes(log, track)) > ROUNDING}
    if not late:
        return
    shifts = [
        boxes_at_frames(log, track)[:, :3, 3] - (log.dataset_from_world @ track.world_from_object)[:, :3, 3]
        for track in tracks
        if track.name in late
    ]
    longest = float(torch.cat(shifts).norm(dim=-1).max())
    yield (
        f"boxes are up to {max(late.values()) / 1e6:.1f} ms from the stamps of their frames (objects: {len(late)}), "
        f"and moved there, by up to {longest:.2g} m"
    )


def _objects(log: DrivingLog, where: Placement) -> Iterator[str]:
    flavor = where.flavor.name
    keys = object_keys(written_tracks(log, flavor))
    if renamed := [name for name, key in keys.items() if name != key]:
        yield f"names of objects are lost ({len(renamed)}): they are the ids in instances_info.json"
    classes = sorted(Counter(track.class_name for track in log.tracks).items())
    names = [(name, class_in(flavor, name), count) for name, count in classes]
    if other := [f"{name} is {known} ({count})" for name, known, count in names if known and known != name]:
        yield f"classes get names that DriveStudio knows in its flavor {flavor} (objects): {', '.join(other)}"
    if unknown := [f"{name} ({count})" for name, known, count in names if known is None]:
        yield (
            f"objects are left out whose classes DriveStudio has no name for, in its flavor {flavor}: "
            f"{', '.join(unknown)}"
        )


def _others(log: DrivingLog, where: Placement) -> Iterator[str]:
    if log.sparse_points is not None:
        yield f"{len(log.sparse_points()):,} sparse points are lost"
    if log.truth is not None:
        yield "what cameras beside the recorded path would see, which this street knows, is lost"


def unread_by_drivestudio(log: DrivingLog, where: Placement, stand_ins: Sequence[int]) -> tuple[str, ...]:
    """Return what DriveStudio's own loaders need a change for, one sentence each; ours read the folder as it is.

    ``stand_ins``: cameras that have poses of the log's first one.
    """
    return (*_unknown_cameras(log, where), *_absent_parts(log, where, stand_ins))


def _unknown_cameras(log: DrivingLog, where: Placement) -> Iterator[str]:
    sizes, flavor = _SIZES[where.flavor.name], where.flavor.name
    if unknown := [str(camera) for camera in where.cameras if camera >= len(sizes)]:
        yield f"DriveStudio's {flavor} has {len(CAMERAS[flavor])} cameras: it reads none of {', '.join(unknown)}"
    seen = {where.cameras[view.indices[1]]: (view.camera.width, view.camera.height) for view in log.views}
    other = [
        f"{camera} has {w}x{h}, not {sizes[camera][0]}x{sizes[camera][1]}"
        for camera, (w, h) in seen.items()
        if camera < len(sizes) and (w, h) != sizes[camera]
    ]
    if other:
        yield (
            f"DriveStudio takes sizes of images from datasets/dataset_meta.py, and intrinsics with them: camera "
            f"{', '.join(other)}; write these sizes there"
        )


def _absent_parts(log: DrivingLog, where: Placement, stand_ins: Sequence[int]) -> Iterator[str]:
    masks, flavor = find_masks(log.frames), where.flavor.name
    tracks = written_tracks(log, flavor)
    absent = [
        *(["lidar, without which it does not start"] if not len(log.sweeps) else []),
        *(["boxes (load_objects=false)"] if not tracks else []),
        *(["bodies (load_smpl=false)"] if all(track.body is None for track in tracks) else []),
        *(["sky masks (load_sky_mask=false)"] if "sky" not in masks.everywhere else []),
        *(["human and vehicle masks (load_dynamic_mask=false)"] if len({*masks.everywhere} - {"sky"}) < 2 else []),
    ]
    if absent:
        yield f"DriveStudio asks for what is not there, unless data.pixel_source says so: {', '.join(absent)}"
    if flavor == "waymo" and (empty := without_sweep(log)):
        yield f"DriveStudio does not open empty sweeps: leave out frames {', '.join(map(str, empty[:5]))}"
    if masks.ego:
        yield f"DriveStudio looks for masks of the recording car in data/ego_masks/{flavor}: copy those of ego_masks"
    if stand_ins:
        cameras = ", ".join(map(str, stand_ins))
        yield f"DriveStudio reads poses of cameras {cameras} too, which the log lacks: they are those of its first one"


_FLOW_CLASS = 9
"""Column of a row of Waymo's."""


@dataclass(frozen=True)
class DriveStudioWriter(LogWriter):
    """What DriveStudio's own loaders and ours read: its flavor of Waymo, or that of nuScenes.

    Waymo's has rigid cameras on a vehicle. nuScenes' has a pose for each image, and ``timestamps_C.txt`` of cameras
    with own instants. Poses are as the log has them, float32 around its origin.
    """

    jpeg_quality: int | None = 95
    """1 to 100, at full resolution of color. None: PNGs, under the names in .jpg that the layout has; whoever opens
    images by their content reads them."""
    flavor: WrittenFlavor = "auto"
    """"auto": waymo for Waymo's logs (``placement.placed``), nuscenes for others."""

    def __post_init__(self) -> None:
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality lies in 1 to 100, got {self.jpeg_quality}: say 95, or null for PNGs")
        if self.flavor not in get_args(WrittenFlavor):
            raise ValueError(f"flavor must be one of {', '.join(get_args(WrittenFlavor))}, got {self.flavor!r}")

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        check_cameras(log)
        where = placed(log, self.flavor)
        layout = _layout(log, where)
        for index, camera in enumerate(where.cameras):
            yield _file(layout.intrinsics(camera), _intrinsics, log, index)
        yield from _clock(log, layout, where)
        if written_tracks(log, where.flavor.name):
            yield _file(layout.instances, instances_info, log, where.flavor.name)
            yield _file(layout.frame_instances, frame_instances, log, where.flavor.name)
        if layout.has_bodies:
            yield _file(layout.bodies, people, log, where)
        for index, frame in find_masks(log.frames).ego.items():
            assert frame.ego is not None  # as find_masks says
            yield _file(Path(EGO_MASKS, f"{where.cameras[index]}.png"), mask_png, frame.ego.numpy())
        yield from _poses(log, layout, where)
        for place, view in enumerate(log.views):
            frame, index = view.indices
            camera = where.cameras[index]
            yield _file(layout.image(frame, camera), self._image, log, place)
            yield from _masks(log, place, camera)
            if layout.has_lidar and index == log.num_cameras - 1:  # its points are in memory for the depth of images
                yield _file(layout.sweep(frame), _points, log, where, frame)

    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        pixels = () if self.jpeg_quality is None else (f"images become JPEG of quality {self.jpeg_quality}",)
        return (*dropped_content(log, placed(log, self.flavor)), *pixels)

    def notes(self, log: DrivingLog) -> tuple[str, ...]:
        where = placed(log, self.flavor)
        what = "a pose for each image" if where.mounts is None else "cameras that are rigid on a vehicle"
        chosen = f"the flavor is {where.flavor.name}, which has {what}; flavor=... names another"
        return (*([chosen] if self.flavor == "auto" else []), *unread_by_drivestudio(log, where, stand_ins(log, where)))

    def _image(self, log: DrivingLog, place: int) -> bytes:
        pixels = log.frames[place].image.numpy()
        return png(pixels) if self.jpeg_quality is None else jpeg(pixels, self.jpeg_quality)


def stand_ins(log: DrivingLog, where: Placement) -> tuple[int, ...]:
    """Cameras that the log lacks, and whose poses DriveStudio's loaders read nonetheless.

    Where there are bodies they read those of all cameras of their data set, and of nuScenes those of camera 0 always.
    """
    bodies = any(track.body is not None for track in written_tracks(log, where.flavor.name))
    read = range(len(CAMERAS[where.flavor.name])) if bodies else range(where.mounts is None)
    return tuple(camera for camera in read if camera not in where.cameras)


def check_cameras(log: DrivingLog) -> None:
    """Raise ValueError unless each instant has an image of each camera, whose calibration stays."""
    names = log.camera_names or tuple(map(str, range(log.num_cameras)))
    there = {view.indices for view in log.views}
    wanted = [(frame, camera) for frame in range(log.num_frames) for camera in range(log.num_cameras)]
    if absent := [pair for pair in wanted if pair not in there]:
        frame, camera = absent[0]
        raise ValueError(
            f"DriveStudio's layout has an image of each camera at each frame, but {len(absent)} of {len(wanted)} are "
            f"absent, the first of camera {names[camera]} at frame {frame}: leave such frames or cameras out "
            "(data.log.first_frame, data.log.last_frame, data.log.cameras)"
        )
    first = {view.camera_index: _numbers_of(view) for view in reversed(log.views)}
    for view in log.views:
        if _numbers_of(view) != first[view.camera_index]:
            frame, camera = view.indices
            raise ValueError(
                f"DriveStudio's layout has one calibration a camera, but that of camera {names[camera]} changes at "
                f"frame {frame}: convert the frames before and behind it apart (data.log.first_frame, .last_frame)"
            )


def _layout(log: DrivingLog, where: Placement) -> Layout:
    """The layout's own names, below no folder."""
    return Layout(
        root=Path(),
        flavor=where.flavor,
        frames=range(log.num_frames),
        cameras=where.cameras,
        front=min(where.cameras),
        num_frames_on_disk=log.num_frames,
        has_lidar=len(log.sweeps) > 0,
        has_bodies=any(track.body is not None for track in written_tracks(log, where.flavor.name)),
    )


def _poses(log: DrivingLog, layout: Layout, where: Placement) -> Iterator[LogFile]:
    """Of cameras, those that the log lacks as its first one, and of vehicle or lidar."""
    numbers = [*enumerate(where.cameras), *((0, camera) for camera in stand_ins(log, where))]
    if where.mounts is not None:
        for index, camera in numbers:
            yield _file(layout.extrinsics(0, camera), _pose, where.mounts[index] @ inverse(AHEAD_FROM_OPENCV))
    else:
        place = {view.indices: place for place, view in enumerate(log.views)}
        for frame in range(log.num_frames):
            for index, camera in numbers:
                yield _file(layout.extrinsics(frame, camera), _pose, where.world_from_camera[place[frame, index]])
    for frame in range(log.num_frames if layout.has_lidar or where.mounts is not None else 0):
        yield _file(layout.sweep_pose(frame), _pose, where.world_from_sweep[frame])


def _file(path: Path, make: Callable[..., bytes], *arguments: Any) -> LogFile:
    return LogFile(path.as_posix(), lambda: (make(*arguments),))


def _numbers_of(view: View) -> list[float]:
    """fx, fy, cx, cy, k1, k2, p1, p2, k3."""
    k = view.camera.intrinsics.double()
    lens = view.camera.distortion
    return [*(float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))), *([0.0] * 5 if lens is None else lens.tolist())]


def _intrinsics(log: DrivingLog, camera: int) -> bytes:
    return number_lines(_numbers_of(next(view for view in log.views if view.camera_index == camera)))


def _pose(pose: Float64[Tensor, "4 4"]) -> bytes:
    return number_lines(pose.numpy())


def _clock(log: DrivingLog, layout: Layout, where: Placement) -> Iterator[LogFile]:
    """Stamps of frames, and of images where they have poses of their own."""
    stamps = frame_stamps(log)
    if stamps is None:
        return
    yield _file(layout.timestamps, seconds_lines, stamps)
    for index, camera in enumerate(where.cameras if where.mounts is None else ()):
        own = [view.stamp for view in log.views if view.camera_index == index and view.stamp is not None]
        if own != list(stamps):
            yield _file(layout.image_timestamps(camera), seconds_lines, own)


def _masks(log: DrivingLog, place: int, camera: int) -> Iterator[LogFile]:
    kinds = find_masks(log.frames).everywhere
    name = f"{log.views[place].indices[0]:03d}_{camera}.png"
    moving = [kind for kind in kinds if kind != "sky"]
    if "sky" in kinds:
        yield _file(Path(SKY_MASKS, name), _mask, log, place, ["sky"])
    for kind in moving:
        yield _file(Path(FINE_MASKS, kind, name), _mask, log, place, [kind])
    if moving:
        yield _file(Path(FINE_MASKS, "all", name), _mask, log, place, moving)


def _mask(log: DrivingLog, place: int, kinds: list[str]) -> bytes:
    """Pixels of any of the kinds."""
    frame = log.frames[place]
    return mask_png(torch.stack([getattr(frame, kind) for kind in kinds]).any(0).numpy())


def _points(log: DrivingLog, where: Placement, frame: int) -> bytes:
    """Rows of the flavor. What a log does not have is 0, and the class of flow -1, none.

    All rays of Waymo's flavor start at the first camera, and are those of the lidar TOP, which alone DriveStudio reads.
    """
    rows = np.zeros((0, where.flavor.columns), np.float32)
    for sweep in log.sweeps.where(lambda index: index == frame).gray():
        rows = np.zeros((len(sweep.points), where.flavor.columns), np.float32)
        sweep_from_world = inverse(where.world_from_sweep[frame]) @ log.dataset_from_world
        first = where.flavor.x_column
        rows[:, first : first + 3] = transform_points(sweep_from_world, sweep.points.double()).numpy()
        intensities = log.sweeps.load_intensities(frame)
        if where.flavor.intensity is not None and intensities is not None:
            rows[:, where.flavor.intensity] = intensities.numpy()
        if where.mounts is not None:
            rows[:, :3], rows[:, _FLOW_CLASS] = where.mounts[0, :3, 3].numpy(), -1
    return rows.astype("<f4").tobytes()
