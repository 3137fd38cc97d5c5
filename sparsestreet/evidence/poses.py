"""How far the camera poses of single images are off: corrections that make the rays of tracked points meet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int

from sparsestreet.data.lazy import Frames, spread
from sparsestreet.geometry.lenses import undistort
from sparsestreet.triangulation import ImagePointSettings, street_points
from sparsestreet.triangulation.points import Observations, TriangulatedPoints, meet, summed
from sparsestreet.types import Frame, Track, View

STEPS = 10
MIN_NOISE = 0.05
"""Pixels; the position of a feature is not known better."""
PRIOR = np.repeat((0.3, 0.03), 3)
"""Standard deviations of corrections, meters and radians: what rays leave open stays near zero."""


@dataclass(frozen=True)
class Bundle:
    """Corrections as motions in the frames of the cameras, and what these move images by."""

    corrections: Float64[np.ndarray, "c 6"]
    """Translation (m) and rotation vector (rad) of each image; 0 of one without observations."""
    slopes: Float64[np.ndarray, "c 6 6"]
    """Mean product of the derivatives of an image's pixels with respect to its correction: with it the mean square of
    what a correction moves the image by, over both axes, is c^T slopes c, in pixels^2."""
    covariance: Float64[np.ndarray, "c 6 c 6"]
    """Of the corrections, by the noise of features alone: how far what rays say disagrees. The prior is no noise."""
    counts: Int[np.ndarray, " c"]
    """Observations of each image."""


def adjust(observations: Observations, image: Int[np.ndarray, " o"], images: int) -> Bundle:
    """Corrections of ``images`` cameras by Gauss-Newton; ``image`` is that of each observation.

    Points are eliminated (Schur), and the corrections have a weak prior. Points start where the rays come closest.
    """
    count = int(observations.point.max(initial=-1)) + 1
    moved, points = observations.camera_from_frame.copy(), meet(observations, count)
    corrections, size = np.zeros((images, 6)), 6 * images
    prior = np.tile(1 / PRIOR**2, images)
    for _ in range(STEPS):
        residual, by_pose, by_point = _derivatives(replace(observations, camera_from_frame=moved), points)
        # Of wrong matches, which there are always some, nothing is left when the noise is found (Geman and McClure).
        noise = max(1.4826 * float(np.median(np.abs(residual))), MIN_NOISE)
        ratio = (residual / (3 * noise)) ** 2
        weight = ((1 + ratio.sum(1)) ** -2 / noise**2)[:, None, None]
        own = _damped(summed(_product(by_point, weight * by_point), observations.point, count))
        mixed = _scattered(_product(by_pose, weight * by_point), image, observations.point, images, count)
        data = np.zeros((size, size))
        for number, block in enumerate(summed(_product(by_pose, weight * by_pose), image, images)):
            data[6 * number : 6 * number + 6, 6 * number : 6 * number + 6] = block
        inverse = np.linalg.inv(own)
        data -= np.einsum("pai,pij,pbj->ab", mixed, inverse, mixed, optimize=True)
        right_pose = summed(_product(by_pose, weight * residual[:, :, None])[:, :, 0], image, images).ravel()
        right_point = summed(_product(by_point, weight * residual[:, :, None])[:, :, 0], observations.point, count)
        right = right_pose - np.einsum("pai,pij,pj->a", mixed, inverse, right_point, optimize=True)
        right += prior * corrections.ravel()
        step = -np.linalg.solve(data + np.diag(prior), right)
        points = points - np.einsum("pij,pj->pi", inverse, right_point + np.einsum("pai,a->pi", mixed, step))
        corrections = corrections + step.reshape(images, 6)
        moved = _moved(observations.camera_from_frame, corrections[image])
    # What noise of the data alone would make of the estimate, which the prior shrinks.
    shrunk = np.linalg.inv(data + np.diag(prior))
    covariance = shrunk @ data @ shrunk
    counts = np.bincount(image, minlength=images)
    slopes = summed(_product(by_pose, by_pose), image, images) / (2 * np.maximum(counts, 1))[:, None, None]
    return Bundle(corrections, slopes, covariance.reshape(images, 6, images, 6), counts)


def _derivatives(
    observations: Observations, points: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "o 2"], Float64[np.ndarray, "o 2 6"], Float64[np.ndarray, "o 2 3"]]:
    """Residuals in pixels, and their derivatives with respect to the camera's motion and to the point."""
    rotation = observations.camera_from_frame[:, :3, :3]
    local = np.einsum("oij,oj->oi", rotation, points[observations.point]) + observations.camera_from_frame[:, :3, 3]
    depth = np.maximum(local[:, 2], 0.1)
    at = local[:, :2] / depth[:, None]
    by_local = np.zeros((len(local), 2, 3))
    by_local[:, 0, 0] = by_local[:, 1, 1] = 1
    by_local[:, :, 2] = -at
    by_local *= (observations.focal / depth)[:, None, None]
    # A turn by w moves a point by w x local: each column is a unit vector x local.
    turned = np.cross(np.eye(3)[None], local[:, None, :])
    by_turn = np.einsum("oij,okj->oik", by_local, turned)
    residual = (at - observations.rays) * observations.focal[:, None]
    return residual, np.concatenate((by_local, by_turn), 2), by_local @ rotation


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a^T b of each observation."""
    return np.einsum("oki,okj->oij", a, b)


def _damped(matrices: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, "n 3 3"]:
    return matrices + (1e-9 * np.trace(matrices, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)


def _scattered(
    blocks: Float64[np.ndarray, "o 6 3"], image: np.ndarray, point: np.ndarray, images: int, points: int
) -> Float64[np.ndarray, "p s 3"]:
    """The sums of the blocks of each point and image, [points, 6 images, 3]."""
    table = np.zeros((points, images, 6, 3))
    np.add.at(table, (point, image), blocks)
    return table.reshape(points, 6 * images, 3)


def _moved(
    poses: Float64[np.ndarray, "o 4 4"], corrections: Float64[np.ndarray, "o 6"]
) -> Float64[np.ndarray, "o 4 4"]:
    """Poses behind corrections, whose turns are exact to the square of a milliradian."""
    x, y, z = corrections[:, 3:].T
    none = np.zeros_like(x)
    skew = np.stack((none, -z, y, z, none, -x, -y, x, none), 1).reshape(-1, 3, 3)
    turn = np.eye(3) + skew + 0.5 * skew @ skew
    moved = poses.copy()
    moved[:, :3] = turn @ poses[:, :3]
    moved[:, :3, 3] += corrections[:, :3]
    return moved


BLOCKS, INSTANTS = 3, 6
"""Stretches of the drive that are looked at, and the instants of each."""
MIN_STEP = 0.6
"""Meters between two instants: from nearer ones rays say nothing."""
FEWEST = 20
"""Observations of an image, below which it says nothing."""
WEIGHTS = np.array([-0.5, 1.0, -0.5]) / np.sqrt(1.5)
"""Of an image and those before and behind it: what is constant or grows evenly falls out."""
POINTS = ImagePointSettings(
    features=600, epipolar_tolerance=4.0, max_error=4.0, min_support=0.3, max_depth_error=0.1, sweep=None, threads=1
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
    """Look at a few stretches of the drive; None where no image shows enough points, as when the car stands.

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
    found = street_points(frames, moving, POINTS).static
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
        if last is None or float((position - last).norm()) >= MIN_STEP:
            instants.append(instant)
            last = position
    starts = spread(max(len(instants) - INSTANTS + 1, 1), min(BLOCKS, max(len(instants) // INSTANTS, 1)))
    return [
        [place for instant in instants[start : start + INSTANTS] for place in by_instant[instant]] for start in starts
    ]


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
