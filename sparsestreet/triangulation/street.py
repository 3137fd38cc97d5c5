"""The points of a drive: static ones in the world, and those of each box in its own frame."""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64

from sparsestreet.data.lazy import Frames
from sparsestreet.geometry.boxes import box_at, through_box
from sparsestreet.geometry.lenses import undistort
from sparsestreet.kept import Kept
from sparsestreet.triangulation.matches import Features, find_features
from sparsestreet.triangulation.points import Sighting, TriangulatedPoints, triangulate
from sparsestreet.triangulation.settings import ENLARGEMENT, ImagePointSettings
from sparsestreet.triangulation.sweep import swept_points, thinned
from sparsestreet.types import Camera, Frame, Track, View

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StreetPoints:
    """Points triangulated from the training images; ``views`` count the training views."""

    static: TriangulatedPoints
    """Static points, in the world; of those far ahead one in each cube."""
    in_boxes: Mapping[str, TriangulatedPoints]
    """Name of a track -> points inside its box, in the box's frame."""
    far: TriangulatedPoints | None = None
    """Static points far ahead, in the world, one for each pixel of a swept view; None: no view was swept."""


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
                through = _through(moved, track)
                still[place] &= ~through
                own[place] = moved.where(through)
        in_boxes[track.name] = _inside(triangulate(list(own.values()), settings), list(own), track)
    static = [sighting.where(mask) for sighting, mask in zip(sightings, still, strict=True)]
    found = triangulate(static, settings, _report)
    carried = sum(map(len, in_boxes.values()))
    log.info("points from %d images: %d that stand still, %d in boxes", len(frames), len(found), carried)
    if settings.sweep is None:
        return StreetPoints(found, in_boxes)
    far = swept_points(frames, moving, settings.sweep, settings.workers, partial(_report, what="views swept"))
    starts = TriangulatedPoints.concatenate((found, thinned(far, settings.sweep.spacing)))
    return StreetPoints(starts, in_boxes, far)


def _report(done: int, total: int, what: str = "pairs compared") -> None:
    """Log a line whenever another quarter is done."""
    if done * 4 // total > (done - 1) * 4 // total:
        log.info("points from images: %d of %d %s", done, total, what)


def _sightings(frames: Frames, settings: ImagePointSettings) -> list[Sighting]:
    """Sightings in the order of the frames. What decodes images, and OpenCV, release the interpreter's lock."""

    def sighting(index: int) -> Sighting:
        return _sighting(frames.views[index], frames[index], settings.features)

    with ThreadPoolExecutor(settings.workers) as executor:
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


def _through(sighting: Sighting, track: Track) -> Bool[np.ndarray, " n"]:
    """Whether each feature's ray meets the box ahead of the camera; the sighting is in the box's frame."""
    rays = np.concatenate((sighting.rays, np.ones((len(sighting.rays), 1))), 1)
    pose = torch.from_numpy(sighting.camera_from_frame)
    return through_box(pose, torch.from_numpy(rays), ENLARGEMENT * track.size).numpy()


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


def kept_street_points(
    kept: Kept, frames: Frames, moving: Sequence[Track], settings: ImagePointSettings
) -> StreetPoints:
    """Return ``street_points``, from an earlier run on the same images if one kept them."""
    said = replace(settings, threads=None), cv2.__version__, moving  # threads change the time, not the points
    make = partial(street_points, frames, moving, settings)
    return kept.get("points", said, make, StreetPoints, TriangulatedPoints)
