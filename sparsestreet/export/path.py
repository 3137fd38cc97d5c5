"""Camera paths: along the recorded views, next to them, and between them."""

import math
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse, moved
from sparsestreet.types import Camera, View

Rig = tuple[View, ...]
"""The views of one instant, lowest camera index first unless another order was chosen."""

CameraPath = tuple[Rig, ...]
"""Rigs in order of time."""

_SAME = 1e-3
"""Fraction of a step; an instant that is this close to a recorded one is the recorded one."""


def recorded(views: Sequence[View]) -> CameraPath:
    """Return the views as they were recorded. Raises ValueError without views.

    >>> camera = Camera(torch.eye(4), torch.eye(3), width=8, height=6)
    >>> path = recorded([View(camera, 1.0, 1, 0), View(camera, 0.0, 0, 0)])
    >>> [rig[0].frame_index for rig in path]
    [0, 1]
    """
    if not views:
        raise ValueError("a path needs views, got none: check that the log's views were written")
    instants = defaultdict(list)
    for view in views:
        instants[view.frame_index].append(view)
    return tuple(tuple(sorted(instants[index], key=lambda view: view.camera_index)) for index in sorted(instants))


def of_frames(path: CameraPath, frames: slice) -> CameraPath:
    """Return the instants whose frame index lies in start:stop. Raises ValueError if there is none."""
    indices = [rig[0].frame_index for rig in path]
    start = 0 if frames.start is None else frames.start
    stop = math.inf if frames.stop is None else frames.stop
    chosen = tuple(rig for rig, index in zip(path, indices, strict=True) if index is not None and start <= index < stop)
    if not chosen:
        raise ValueError(f"no view lies in frames {start} to {stop}: the path has {indices[0]} to {indices[-1]}")
    return chosen


def of_cameras(path: CameraPath, cameras: Sequence[int]) -> CameraPath:
    """Return only these cameras, in the given order. Raises ValueError for a camera that any instant lacks."""
    return tuple(tuple(_view_of(rig, index) for index in cameras) for rig in path)


def left_to_right(rig: Rig) -> list[int]:
    """Return camera indices, leftmost first, by the yaw of their optical axes relative to the rig's first camera.

    >>> camera = Camera(torch.eye(4), torch.eye(3), width=8, height=6)
    >>> left_to_right((View(camera, 0.0, 0, 0), View(camera, 0.0, 0, 1)))
    [0, 1]
    """
    front_from_world = rig[0].camera.camera_from_world[:3, :3].double()

    def yaw(view: View) -> float:
        """Return the angle to the right of the first camera, radians; row 3 of camera_from_world is the world axis."""
        x, _, z = (front_from_world @ view.camera.camera_from_world[2, :3].double()).tolist()
        return round(math.atan2(x, z), 6)

    return [_camera_of(view) for view in sorted(rig, key=lambda view: (yaw(view), _camera_of(view)))]


def shifted(path: CameraPath, offset: float, *, gradually: bool = False) -> CameraPath:
    """Return every rig moved sideways as one, ``offset`` meters to the right of its camera with the lowest index.

    ``gradually``: as in a change of lane, from nothing at the first instant to all at the last, 3 s^2 - 2 s^3 of it at
    fraction s of the time between. The views keep time and camera index. They lose their frame index, because nobody
    recorded them. Shift before you choose cameras.

    >>> path = recorded([View(Camera(torch.eye(4), torch.eye(3), width=8, height=6), 0.0, 0, 0)])
    >>> shifted(path, 2.0)[0][0].camera.position.tolist()
    [2.0, 0.0, 0.0]
    """

    front = min(_camera_of(view) for view in path[0])

    start, end = path[0][0].time, path[-1][0].time

    def share(rig: Rig) -> float:
        s = (rig[0].time - start) / (end - start) if end > start else 0.0
        return s * s * (3 - 2 * s) if gradually else 1.0

    def beside(rig: Rig) -> Rig:
        vector = share(rig) * offset * _view_of(rig, front).camera.camera_from_world[0, :3].double()
        return tuple(replace(bare(view), camera=moved(view.camera, vector), frame_index=None) for view in rig)

    return tuple(beside(rig) for rig in path)


def resampled(path: CameraPath, step: float) -> CameraPath:
    """Return an instant every ``step`` of normalized time from the first to the last.

    Positions are interpolated linearly, rotations by slerp. An instant that coincides with one of the path is that one;
    the others have no frame index. Raises ValueError for a step that is not above 0.

    >>> camera = Camera(torch.eye(4), torch.eye(3), width=8, height=6)
    >>> path = resampled(recorded([View(camera, 0.0, 0, 0), View(camera, 1.0, 1, 0)]), step=0.5)
    >>> [(rig[0].time, rig[0].frame_index) for rig in path]
    [(0.0, 0), (0.5, None), (1.0, 1)]
    """
    if not step > 0:
        raise ValueError(f"a path is resampled in steps above 0, got {step}: use more frames a second")
    times = [rig[0].time for rig in path]
    count = math.floor((times[-1] - times[0]) / step + _SAME) + 1
    return tuple(_rig_at(path, times, times[0] + index * step, step) for index in range(count))


def resized(path: CameraPath, width: int) -> CameraPath:
    """Return all cameras with images ``width`` pixels wide, the height in proportion.

    >>> path = recorded([View(Camera(torch.eye(4), torch.eye(3), width=8, height=6), 0.0, 0, 0)])
    >>> resized(path, 4)[0][0].camera.height
    3
    """
    if width < 1:
        raise ValueError(f"an image is at least 1 pixel wide, got width {width}")
    return _each_camera(path, lambda camera: _scaled(camera, width))


def _camera_of(view: View) -> int:
    if view.camera_index is None:
        raise ValueError("a view of a path has a camera index, got None: take views of the log's cameras")
    return view.camera_index


def _view_of(rig: Rig, camera: int) -> View:
    found = [view for view in rig if view.camera_index == camera]
    if not found:
        there = [view.camera_index for view in rig]
        raise ValueError(
            f"there is no camera {camera} in frame {rig[0].frame_index}, only {there}: choose other cameras or frames"
        )
    return found[0]


def bare(view: View) -> View:
    """Return the view without a Frame's pixels, which belong to its recorded pose."""
    return View(view.camera, view.time, view.frame_index, view.camera_index, view.seconds, view.stamp)


def _each_camera(path: CameraPath, change: Callable[[Camera], Camera]) -> CameraPath:
    return tuple(tuple(replace(bare(view), camera=change(view.camera)) for view in rig) for rig in path)


def _scaled(camera: Camera, width: int) -> Camera:
    height = max(round(camera.height * width / camera.width), 1)
    factors = torch.tensor([width / camera.width, height / camera.height, 1.0], dtype=camera.intrinsics.dtype)
    # Pixel centers lie at +0.5, so a change of size only changes the unit.
    return replace(camera, intrinsics=factors[:, None] * camera.intrinsics, width=width, height=height)


def _rig_at(path: CameraPath, times: Sequence[float], time: float, step: float) -> Rig:
    before = min(max(bisect_right(times, time) - 1, 0), len(path) - 1)
    after = min(before + 1, len(path) - 1)
    for index in (before, after):
        if abs(times[index] - time) <= _SAME * step:
            return path[index]
    fraction = (time - times[before]) / (times[after] - times[before])
    return tuple(_between(a, b, fraction) for a, b in zip(path[before], path[after], strict=True))


def _between(a: View, b: View, fraction: float) -> View:
    first, second = (inverse(view.camera.camera_from_world.double()) for view in (a, b))
    world_from_camera = first.clone()
    start, end = (quat.from_matrix(pose[:3, :3]) for pose in (first, second))
    world_from_camera[:3, :3] = quat.to_matrix(quat.slerp(start, end, torch.tensor(fraction, dtype=torch.float64)))
    world_from_camera[:3, 3] = torch.lerp(first[:3, 3], second[:3, 3], fraction)
    pose = inverse(world_from_camera).to(a.camera.camera_from_world.dtype)
    time = a.time + fraction * (b.time - a.time)
    seconds = None
    if a.seconds is not None and b.seconds is not None:
        seconds = a.seconds + fraction * (b.seconds - a.seconds)
    return View(replace(a.camera, camera_from_world=pose), time, None, a.camera_index, seconds)


def raised(path: CameraPath, meters: float) -> CameraPath:
    """Return every camera moved up in the world; the views lose their frame index, as nobody recorded them."""
    vector = torch.tensor([0.0, 0.0, meters], dtype=torch.float64)
    rigs = [[replace(bare(view), camera=moved(view.camera, vector), frame_index=None) for view in rig] for rig in path]
    return tuple(tuple(rig) for rig in rigs)


def cropped(path: CameraPath, height: int) -> CameraPath:
    """Return images so many pixels high: as many rows come or go above as below, and nothing is scaled."""

    def change(camera: Camera) -> Camera:
        matrix = camera.intrinsics.clone()
        matrix[1, 2] += (height - camera.height) / 2
        return replace(camera, intrinsics=matrix, height=height)

    return _each_camera(path, change)


def pinholes(path: CameraPath, fov: float) -> CameraPath:
    """Return pinholes of a horizontal field of view, degrees, with square pixels and their axis in the middle.

    Raises ValueError for a field of view that no pinhole has.
    """
    if not 0 < fov < 180:
        raise ValueError(f"a pinhole sees more than 0 and less than 180 degrees, got fov={fov:g}")

    def change(camera: Camera) -> Camera:
        focal = camera.width / 2 / math.tan(math.radians(fov) / 2)
        return replace(
            camera, intrinsics=intrinsics(focal, focal, camera.width / 2, camera.height / 2), distortion=None
        )

    return _each_camera(path, change)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> torch.Tensor:
    """Return the matrix of a pinhole, pixels.

    >>> intrinsics(2.0, 3.0, 4.0, 5.0).tolist()
    [[2.0, 0.0, 4.0], [0.0, 3.0, 5.0], [0.0, 0.0, 1.0]]
    """
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
