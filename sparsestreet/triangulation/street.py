"""The points of a drive: static ones in the world, and those of each box in its own frame."""

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from threading import Lock

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64

from sparsestreet.atomic import atomic_file
from sparsestreet.data.lazy import Frames
from sparsestreet.files import read_npz
from sparsestreet.geometry.boxes import box_at
from sparsestreet.geometry.lenses import undistort
from sparsestreet.triangulation.matches import Features, find_features
from sparsestreet.triangulation.points import ImagePointSettings, Sighting, TriangulatedPoints, triangulate
from sparsestreet.types import Camera, Frame, Track, View

log = logging.getLogger(__name__)

ENLARGEMENT = 1.1
"""Factor of a box's size, for points just outside an imprecise box."""


@dataclass(frozen=True)
class StreetPoints:
    """Points triangulated from the training images; ``views`` count the training views."""

    static: TriangulatedPoints
    """Static points, in the world."""
    in_boxes: Mapping[str, TriangulatedPoints]
    """Name of a track -> points inside its box, in the box's frame."""


def street_points(frames: Frames, moving: Sequence[Track], settings: ImagePointSettings) -> StreetPoints:
    """Find points in images; each image is decoded once.

    Args:
        frames: training views.
        moving: objects that move on their own; features seen through their boxes count only for them.
        settings: limits of the search.
    """
    sightings = _sightings(frames, settings)
    still = [np.ones(len(sighting.features), bool) for sighting in sightings]
    in_boxes = {}
    for track in moving:
        own = {}
        for place, sighting in enumerate(sightings):
            moved = _from_box(sighting, track)
            if moved is not None:
                through = _through_box(moved, track)
                still[place] &= ~through
                own[place] = moved.where(through)
        in_boxes[track.name] = _inside(triangulate(list(own.values()), settings), list(own), track)
    static = [sighting.where(mask) for sighting, mask in zip(sightings, still, strict=True)]
    points = StreetPoints(triangulate(static, settings, _report), in_boxes)
    carried = sum(map(len, in_boxes.values()))
    log.info("points from %d images: %d that stand still, %d in boxes", len(frames), len(points.static), carried)
    return points


def _report(done: int, total: int) -> None:
    """Log a line whenever another quarter of the pairs is compared."""
    if done * 4 // total > (done - 1) * 4 // total:
        log.info("points from images: %d of %d pairs compared", done, total)


def _sightings(frames: Frames, settings: ImagePointSettings) -> list[Sighting]:
    """Sightings in the order of the frames. OpenCV releases the interpreter's lock, so threads run in parallel."""
    reading = Lock()  # one frame is decoded at a time: the threads are for the features

    def sighting(index: int) -> Sighting:
        with reading:
            frame = frames[index]
        return _sighting(frames.views[index], frame, settings.features)

    with ThreadPoolExecutor(settings.threads) as executor:
        return list(executor.map(sighting, range(len(frames))))


def _sighting(view: View, frame: Frame, limit: int) -> Sighting:
    """The features of a frame outside the sky and the recording car, without the frame's pixels."""
    image = frame.image.numpy()
    features = find_features(image, limit)
    for mask in (frame.sky, frame.ego):
        if mask is not None:
            features = features.where(~mask.numpy()[_pixel(features, frame.camera)])
    return Sighting(
        view,
        frame.camera.camera_from_world.double().numpy(),
        features,
        _rays(features.pixels, frame.camera),
        image[_pixel(features, frame.camera)].astype(np.float32) / 255,
    )


def _pixel(features: Features, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the pixel that each feature lies in."""
    column, row = features.pixels.astype(np.int64).T
    return row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)


def _rays(pixels: Float64[np.ndarray, "n 2"], camera: Camera) -> Float64[np.ndarray, "n 2"]:
    """Normalized image points without lens distortion."""
    intrinsics = camera.intrinsics.double().numpy()
    imaged = np.linalg.solve(intrinsics[:2, :2], (pixels - intrinsics[:2, 2]).T).T
    if camera.distortion is None:
        return imaged
    return undistort(torch.from_numpy(imaged), camera.distortion.double()).numpy()


def _from_box(sighting: Sighting, track: Track) -> Sighting | None:
    """The sighting with its pose in the frame of the box at the view's time; None if the box is not annotated then."""
    world_from_box = box_at(track, sighting.view.indices[0], sighting.view.time)
    if world_from_box is None:
        return None
    return replace(sighting, camera_from_frame=sighting.camera_from_frame @ world_from_box.numpy())


def _through_box(sighting: Sighting, track: Track) -> Bool[np.ndarray, " n"]:
    """Whether each feature's ray meets the box ahead of the camera (slab test); the sighting is in the box's frame."""
    rotation, translation = sighting.camera_from_frame[:3, :3], sighting.camera_from_frame[:3, 3]
    center = -rotation.T @ translation
    rays = np.concatenate((sighting.rays, np.ones((len(sighting.rays), 1))), 1) @ rotation
    half = ENLARGEMENT / 2 * track.size.double().numpy()
    with np.errstate(divide="ignore", invalid="ignore"):
        to_planes = np.stack(((-half - center) / rays, (half - center) / rays))
    enter, leave = to_planes.min(0).max(1), to_planes.max(0).min(1)
    return (enter <= leave) & (leave > 0)


def _inside(points: TriangulatedPoints, views: list[int], track: Track) -> TriangulatedPoints:
    """The points that lie in the box; ``views`` are the places of its views among all."""
    kept = np.all(np.abs(points.positions) <= ENLARGEMENT / 2 * track.size.numpy(), axis=1)
    number, of_kept = np.cumsum(kept) - 1, kept[points.observed]
    return TriangulatedPoints(
        points.positions[kept],
        points.colors[kept],
        points.pixel_sizes[kept],
        number[points.observed[of_kept]],
        np.array(views, np.int64)[points.views[of_kept]],
        points.pixels[of_kept],
    )


VERSION = 1
"""Raised whenever the same images and settings would give other points."""

_COLUMNS = ("positions", "colors", "pixel_sizes", "observed", "views", "pixels")


def cached_street_points(frames: Frames, moving: Sequence[Track], settings: ImagePointSettings) -> StreetPoints:
    """Return ``street_points``, from the cache if the same images, poses, boxes and settings made them before.

    Raises OSError before any work if the cache cannot be written.
    """
    if settings.cache is None:
        return street_points(frames, moving, settings)
    path = Path(settings.cache) / f"{_key(frames, moving, settings)}.npz"
    if path.is_file() and (kept := _read(path)) is not None:
        log.info("points from images: taken from %s", path)
        return kept
    with atomic_file(path) as unfinished:
        points = street_points(frames, moving, settings)
        _write(unfinished, points)
    return points


def _key(frames: Frames, moving: Sequence[Track], settings: ImagePointSettings) -> str:
    said = asdict(settings) | {"version": VERSION, "opencv": cv2.__version__}
    for name in ("threads", "cache"):  # they change the time, not the points
        said.pop(name)
    digest = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    for frame in frames:
        camera = frame.camera
        digest.update(f"{frame.frame_index} {frame.camera_index} {camera.width} {camera.height}".encode())
        for tensor in (camera.camera_from_world, camera.intrinsics, camera.distortion, frame.image, frame.sky):
            digest.update(b"-" if tensor is None else tensor.numpy().tobytes())
        if frame.ego is not None:
            digest.update(frame.ego.numpy().tobytes())
    for track in moving:
        digest.update(track.name.encode())
        for tensor in (track.frames, track.world_from_object, track.size):
            digest.update(tensor.numpy().tobytes())
        if track.times is not None:  # the box at a view's time lies between two annotated ones
            digest.update(track.times.numpy().tobytes())
    if any(track.times is not None for track in moving):
        digest.update(json.dumps([view.time for view in frames.views]).encode())
    return digest.hexdigest()[:16]


def _write(path: Path, points: StreetPoints) -> None:
    parts = [points.static, *points.in_boxes.values()]
    tables = {f"{column}_{number}": getattr(part, column) for number, part in enumerate(parts) for column in _COLUMNS}
    np.savez(path, names=np.array(list(points.in_boxes), dtype=np.str_), **tables)


def _read(path: Path) -> StreetPoints | None:
    """None, and a warning, for a file that is damaged."""
    try:
        tables = read_npz(path)
        count = len(tables["names"]) + 1
        parts = [TriangulatedPoints(*(tables[f"{column}_{number}"] for column in _COLUMNS)) for number in range(count)]
        return StreetPoints(parts[0], dict(zip(tables["names"].tolist(), parts[1:], strict=True)))
    except (ValueError, KeyError, TypeError) as error:
        log.warning("points from images: %s is damaged (%s), so they are made anew", path, error)
        return None
