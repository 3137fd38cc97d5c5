"""How far the camera poses of single images are off: corrections that make the rays of tracked points meet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int

from sparsestreet.data.lazy import Frames, spread
from sparsestreet.evidence.bundle import Bundle, adjust
from sparsestreet.geometry.lenses import undistort
from sparsestreet.triangulation import ImagePointSettings, street_points
from sparsestreet.triangulation.points import TriangulatedPoints
from sparsestreet.triangulation.rays import Observations
from sparsestreet.types import Frame, Track, View

BLOCKS, INSTANTS = 3, 6
"""Stretches of the drive that are looked at, and the instants of each."""
LEAST_STEP = 0.6
"""Meters between two instants: from nearer ones rays say nothing."""
FEWEST = 20
"""Observations of an image, below which it says nothing."""
WEIGHTS = np.array([-0.5, 1.0, -0.5]) / np.sqrt(1.5)
"""Of an image and those before and behind it: what is constant or grows evenly falls out."""
POINTS = ImagePointSettings(
    features=600, epipolar_tolerance=4.0, max_error=4.0, min_support=0.3, max_depth_error=0.1, threads=1
)
"""Wide enough for poses that are a few pixels off."""


@dataclass(frozen=True)
class PoseNoise:
    """What poses move the images by, in pixels, root mean square of both axes. Only errors that change from one image
    to the next count: those of a whole stretch look like another street."""

    value: float
    """Of the median image, without the noise of features."""
    error: float
    """Standard error, by stretches; NaN of a single one."""
    constant: float
    """What is common to all images of a camera, of the camera that has most: its calibration or its stamps."""
    images: int
    points: int
    by_image: Float64[np.ndarray, " i"]
    """What each image is moved by, in order of the drive, pixels; the noise of features is in it."""
    indices: Int[np.ndarray, "i 2"]
    """Frame and camera of each image."""


@dataclass(frozen=True)
class _Stretch:
    """Images between two others of their camera, and what all of the stretch are corrected by."""

    indices: Int[np.ndarray, "i 2"]
    squares: Float64[np.ndarray, " i"]
    floor: Float64[np.ndarray, " i"]
    """What the noise of features makes of the squares."""
    bundle: Bundle
    cameras: Int[np.ndarray, " c"]
    points: int


def pose_noise(frames: Frames, moving: Sequence[Track]) -> PoseNoise | None:
    """Looks at a few stretches of the drive; None where no image shows enough points, as when the car stands.

    The rays of points that SIFT finds in several images meet if poses are right. A bundle adjustment of each stretch
    says how each image has to move for it. Errors of an image are what its correction differs by from those before and
    behind it: with the weights 1/2, 1, 1/2 over sqrt(3/2), which independent errors keep their size in.

    Args:
        frames: training views.
        moving: objects that move on their own; what is seen through their boxes does not count.
    """
    found = [_stretch(frames.at(places), moving) for places in _stretches(frames.views)]
    stretches = [each for each in found if each is not None]
    if not stretches:
        return None
    return PoseNoise(
        _noise(stretches),
        _standard_error(stretches),
        _constant(stretches),
        sum(len(each.squares) for each in stretches),
        sum(each.points for each in stretches),
        np.sqrt(np.concatenate([each.squares for each in stretches])),
        np.concatenate([each.indices for each in stretches]),
    )


def seen_from(frames: Frames, views: Sequence[View]) -> Frames:
    """The same images, taken to be seen from other cameras; they are read when they are indexed."""
    places = {view.indices: place for place, view in enumerate(frames.views)}

    def load(view: View) -> Frame:
        return replace(frames[places[view.indices]], camera=view.camera)

    return Frames(views, load)


def _noise(stretches: Sequence[_Stretch]) -> float:
    excess = np.concatenate([each.squares - each.floor for each in stretches])
    return float(np.sqrt(max(np.median(excess), 0.0)))


def _standard_error(stretches: Sequence[_Stretch]) -> float:
    """By the jackknife over stretches."""
    count = len(stretches)
    if count < 2:
        return float("nan")
    without = np.array([_noise([*stretches[:left], *stretches[left + 1 :]]) for left in range(count)])
    return float(np.sqrt((count - 1) / count * np.square(without - without.mean()).sum()))


def _constant(stretches: Sequence[_Stretch]) -> float:
    """The median correction of each camera, which a few wrong images do not move, as pixels."""
    cameras = np.concatenate([each.cameras for each in stretches])
    corrections = np.concatenate([each.bundle.corrections for each in stretches])
    slopes = np.concatenate([each.bundle.slopes for each in stretches])
    found = []
    for camera in np.unique(cameras):
        middle = np.median(corrections[cameras == camera], axis=0)
        found.append(float(np.sqrt(middle @ slopes[cameras == camera].mean(0) @ middle)))
    return max(found)


def _stretch(frames: Frames, moving: Sequence[Track]) -> _Stretch | None:
    found = street_points(_without_car(frames), moving, POINTS).static
    if not len(found):
        return None
    bundle = adjust(_observations(found, frames.views), found.views, len(frames))
    indices = np.array([view.indices for view in frames.views], np.int64)
    places, squares, floor = [], [], []
    for camera in np.unique(indices[:, 1]):
        own = np.flatnonzero((indices[:, 1] == camera) & (bundle.counts >= FEWEST))
        for three in zip(own, own[1:], own[2:], strict=False):
            step = WEIGHTS @ bundle.corrections[list(three)]
            block = bundle.covariance[list(three)][:, :, list(three)]
            scatter = np.einsum("a,b,aibj->ij", WEIGHTS, WEIGHTS, block)
            slopes = bundle.slopes[three[1]]
            places.append(three[1])
            squares.append(float(step @ slopes @ step))
            floor.append(float((slopes * scatter).sum()))
    if not places:
        return None
    return _Stretch(indices[places], np.array(squares), np.array(floor), bundle, indices[:, 1], len(found))


def _stretches(views: Sequence[View]) -> list[list[int]]:
    """Places of the images of each stretch: those of instants that follow each other, some way apart."""
    instants: list[int] = []
    last = None
    by_instant: dict[int, list[int]] = {}
    for place, view in enumerate(views):
        by_instant.setdefault(view.indices[0], []).append(place)
    for instant, places in by_instant.items():
        position = views[places[0]].camera.position
        if last is None or float((position - last).norm()) >= LEAST_STEP:
            instants.append(instant)
            last = position
    starts = spread(max(len(instants) - INSTANTS + 1, 1), min(BLOCKS, max(len(instants) // INSTANTS, 1)))
    return [
        [place for instant in instants[start : start + INSTANTS] for place in by_instant[instant]] for start in starts
    ]


def _without_car(frames: Frames) -> Frames:
    """The recording car stands still in every image, so its pixels count as those of the sky: for nothing."""
    places = {view.indices: place for place, view in enumerate(frames.views)}

    def load(view: View) -> Frame:
        frame = frames[places[view.indices]]
        if frame.ego is None:
            return frame
        return replace(frame, sky=frame.ego if frame.sky is None else frame.sky | frame.ego)

    return Frames(frames.views, load)


def _observations(points: TriangulatedPoints, views: Sequence[View]) -> Observations:
    poses = np.stack([view.camera.camera_from_world.double().numpy() for view in views])
    focal = np.array([float(view.camera.intrinsics[0, 0]) for view in views])
    rays = np.zeros((len(points.pixels), 2))
    for number, view in enumerate(views):
        own = points.views == number
        intrinsics = view.camera.intrinsics.double().numpy()
        imaged = np.linalg.solve(intrinsics[:2, :2], (points.pixels[own] - intrinsics[:2, 2]).T).T
        lens = view.camera.distortion
        rays[own] = imaged if lens is None else undistort(torch.from_numpy(imaged), lens.double()).numpy()
    return Observations(points.observed, poses[points.views], rays, focal[points.views])
