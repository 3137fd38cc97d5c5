"""Points on disk, named by everything that determines them."""

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from sparsestreet.atomic import atomic_file
from sparsestreet.data.lazy import Frames
from sparsestreet.files import read_npz
from sparsestreet.triangulation.points import TriangulatedPoints
from sparsestreet.triangulation.settings import ImagePointSettings
from sparsestreet.triangulation.street import StreetPoints, street_points
from sparsestreet.types import Track

log = logging.getLogger(__name__)

VERSION = 1
"""Raised whenever the same images and settings would give other points."""

_COLUMNS = ("positions", "colors", "pixel_sizes", "observed", "views", "pixels")


def cached_street_points(frames: Frames, moving: Sequence[Track], settings: ImagePointSettings) -> StreetPoints:
    """Returns ``street_points``, from the cache if the same images, poses, boxes and settings made them before.

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
