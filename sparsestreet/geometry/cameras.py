"""Projection and rays outside the splat op, through the lens if there is one, and the camera's position.

Used to color lidar points, to test whether seeds are visible, and for rays to the sky.
"""

from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.geometry.lenses import distort, fold_radius_squared, undistort
from sparsestreet.types import Camera


def transform_points(a_from_b: Float[Tensor, "4 4"], points_in_b: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points of frame b in frame a.

    >>> a_from_b = torch.eye(4)
    >>> a_from_b[0, 3] = 2.0
    >>> transform_points(a_from_b, torch.tensor([[1.0, 0.0, 0.0]])).tolist()
    [[3.0, 0.0, 0.0]]
    """
    return points_in_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def inverse(a_from_b: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """The transform b_from_a of a rigid a_from_b, without a linear solve.

    >>> a_from_b = torch.eye(4)
    >>> a_from_b[:3, 3] = torch.tensor([2.0, 3.0, 1.0])
    >>> inverse(a_from_b)[:3, 3].tolist()
    [-2.0, -3.0, -1.0]
    """
    transposed = a_from_b[..., :3, :3].mT
    b_from_a = torch.zeros_like(a_from_b)
    b_from_a[..., :3, :3] = transposed
    b_from_a[..., :3, 3] = -(transposed @ a_from_b[..., :3, 3:]).squeeze(-1)
    b_from_a[..., 3, 3] = 1
    return b_from_a


def rigidity_error(a_from_b: Float[Tensor, "4 4"]) -> float:
    """The largest absolute entry of R^T R - I and of the last row less (0, 0, 0, 1); at least 1 for a reflection.

    >>> rigidity_error(torch.diag(torch.tensor([2.0, 1.0, 1.0, 1.0])))
    3.0
    """
    rotation = a_from_b[:3, :3]
    identity = torch.eye(3, dtype=a_from_b.dtype)
    last = a_from_b[3] - torch.tensor([0, 0, 0, 1], dtype=a_from_b.dtype)
    error = max(float((rotation.T @ rotation - identity).abs().max()), float(last.abs().max()))
    return max(error, 1.0) if torch.linalg.det(rotation) < 0 else error


def numbers_of(camera: Camera) -> tuple[object, ...]:
    """All that a rendering by the camera depends on: hashable, and equal for cameras of equal numbers.

    What is kept by it cannot grow stale, because a camera whose tensors were changed has other numbers.

    >>> camera = Camera(torch.eye(4), torch.eye(3), width=4, height=4)
    >>> before = numbers_of(camera)
    >>> camera.camera_from_world[0, 3] = 1.0
    >>> before == numbers_of(camera)
    False
    """
    pose, intrinsics, shutter = camera.camera_from_world.tolist(), camera.intrinsics.tolist(), camera.shutter
    effects = [] if camera.distortion is None else [camera.distortion]
    if shutter is not None:
        effects += (shutter.translation, shutter.rotation)
    numbers = [(tensor.shape, *tensor.flatten().tolist()) for tensor in effects]
    direction = None if shutter is None else shutter.direction
    size = camera.width, camera.height
    return (*map(tuple, pose), *map(tuple, intrinsics), *numbers, camera.distortion is None, direction, *size)


def exact_position(camera: Camera) -> Float64[Tensor, "3"]:
    """The camera's center c in R (m - c) = R m + t, meters, in float64 for any dtype of the pose.

    It solves for c, because a rotation is orthonormal only to its dtype's last digit. Over 20 km that digit of a
    float32 is 1 mm.

    >>> camera_from_world = torch.eye(4)
    >>> camera_from_world[:3, 3] = torch.tensor([0.0, 0.0, 2.0])
    >>> exact_position(Camera(camera_from_world, torch.eye(3), width=4, height=4)).tolist()
    [0.0, 0.0, -2.0]
    """
    pose = camera.camera_from_world.detach().double()
    return torch.linalg.solve(pose[:3, :3], -pose[:3, 3])


def moved(camera: Camera, vector: Float64[Tensor, "3"]) -> Camera:
    """The camera moved by ``vector`` in the world, meters; its rotation stays.

    >>> camera = Camera(torch.eye(4), torch.eye(3), width=4, height=4)
    >>> moved(camera, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).position.tolist()
    [1.0, 0.0, 0.0]
    """
    pose = camera.camera_from_world.double().clone()
    pose[:3, 3] -= pose[:3, :3] @ vector
    return replace(camera, camera_from_world=pose.to(camera.camera_from_world.dtype))


def resized(camera: Camera, height: int, width: int) -> Camera:
    """The camera with an image of another size that shows the same.

    >>> intrinsics = torch.tensor([[10.0, 0.0, 2.0], [0.0, 10.0, 2.0], [0.0, 0.0, 1.0]])
    >>> resized(Camera(torch.eye(4), intrinsics, width=4, height=4), 2, 2).intrinsics[0].tolist()
    [5.0, 0.0, 1.0]
    """
    scale = torch.tensor([[width / camera.width], [height / camera.height], [1.0]]).to(camera.intrinsics)
    return replace(camera, intrinsics=scale * camera.intrinsics, width=width, height=height)


def project(
    camera: Camera, points: Float[Tensor, "n 3"], near: float = 0.2
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Return pixel coordinates, depths along the optical axis (meters), and whether each world point is in the image.

    A point past the fold of a lens (``geometry.lenses``) is not in the image. The points may be on any device; the
    camera is on the host.

    >>> intrinsics = torch.tensor([[10.0, 0.0, 2.0], [0.0, 10.0, 2.0], [0.0, 0.0, 1.0]])
    >>> camera = Camera(torch.eye(4), intrinsics, width=4, height=4)
    >>> pixels, depth, inside = project(camera, torch.tensor([[0.0, 0.0, 5.0], [5.0, 0.0, 5.0], [0.0, 0.0, -5.0]]))
    >>> pixels[:2].tolist(), depth.tolist(), inside.tolist()
    ([[2.0, 2.0], [12.0, 2.0]], [5.0, 5.0, -5.0], [True, False, False])
    """
    in_camera = transform_points(camera.camera_from_world.to(points), points)
    depth = in_camera[:, 2]
    safe = depth.clamp(min=near)
    seen = depth > near
    if camera.distortion is not None:
        slopes = in_camera[:, :2] / safe[:, None]
        seen = seen & (slopes.square().sum(-1) <= fold_radius_squared(camera.distortion))
        in_camera = torch.cat((safe[:, None] * distort(slopes, camera.distortion), depth[:, None]), dim=1)
    pixels = (in_camera @ camera.intrinsics.to(points).T)[:, :2] / safe[:, None]
    inside = seen & (pixels >= 0).all(-1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    return pixels, depth, inside


def ray_matrix(camera: Camera) -> list[list[float]]:
    """The matrix R^T K^-1 of a pinhole, 3x3 in float64: from an image point (x, y, 1) in pixels to its world direction.

    The directions are not of unit length.

    >>> intrinsics = torch.tensor([[10.0, 0.0, 2.0], [0.0, 10.0, 2.0], [0.0, 0.0, 1.0]])
    >>> matrix = torch.tensor(ray_matrix(Camera(torch.eye(4), intrinsics, width=4, height=4)))
    >>> (matrix @ torch.tensor([2.0, 2.0, 1.0])).tolist()
    [0.0, 0.0, 1.0]
    """
    pose, ((fx, _, cx), (_, fy, cy), _) = camera.camera_from_world.tolist(), camera.intrinsics.tolist()
    columns = zip(*(row[:3] for row in pose[:3]), strict=True)
    return [[right / fx, down / fy, ahead - right * cx / fx - down * cy / fy] for right, down, ahead in columns]


def ray_directions(camera: Camera, device: torch.device | str = "cpu") -> Float[Tensor, "h w 3"]:
    """Unit directions in the world through the pixel centers, in the camera's dtype, on a device.

    The rays of a lens take one or two seconds per million pixels, once for all views of a camera. Raises ValueError
    where the lens has no inverse.

    >>> intrinsics = torch.tensor([[10.0, 0.0, 1.5], [0.0, 10.0, 1.5], [0.0, 0.0, 1.0]])
    >>> rays = ray_directions(Camera(torch.eye(4), intrinsics, width=3, height=3))
    >>> rays.shape, rays[1, 1].tolist()
    (torch.Size([3, 3, 3]), [0.0, 0.0, 1.0])
    """
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    image = ((fx, fy, cx, cy), camera.width, camera.height, camera.intrinsics.dtype, torch.device(device))
    if camera.distortion is None:
        in_camera = _pinhole_rays(*image)
    else:
        in_camera = _lens_rays(tuple(camera.distortion.tolist()), *image)
    in_world = in_camera @ camera.camera_from_world[:3, :3].to(device, non_blocking=True)
    return in_world / in_world.norm(dim=-1, keepdim=True)


def _pinhole_rays(
    intrinsics: tuple[float, ...], width: int, height: int, dtype: torch.dtype, device: torch.device
) -> Float[Tensor, "h w 3"]:
    """Directions (x, y, 1) in the camera through the pixel centers; ``intrinsics`` are fx, fy, cx, cy."""
    fx, fy, cx, cy = intrinsics
    x = (torch.arange(width, dtype=dtype, device=device) + 0.5 - cx) / fx
    y = (torch.arange(height, dtype=dtype, device=device) + 0.5 - cy) / fy
    y, x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack((x, y, torch.ones_like(x)), dim=-1)


@lru_cache(maxsize=8)  # the cameras of a rig; 12 bytes a pixel in float32
def _lens_rays(
    distortion: tuple[float, ...],
    intrinsics: tuple[float, ...],
    width: int,
    height: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Float[Tensor, "h w 3"]:
    rays = _pinhole_rays(intrinsics, width, height, torch.float64, device)
    rays[..., :2] = undistort(rays[..., :2], torch.tensor(distortion, dtype=torch.float64))
    return rays.to(dtype)


def distance_to_view(camera: Camera, points: Float[Tensor, "n 3"], margin: float = 0.0) -> Float[Tensor, " n"]:
    """A lower bound of the distance from world points to what a camera sees, meters; negative inside.

    The image is first enlarged by ``margin`` of its size on each side. Lens and shutter are ignored; the margin must
    cover what they show beyond the pinhole's image. Never waits for a GPU.

    >>> intrinsics = torch.tensor([[2.0, 0.0, 2.0], [0.0, 2.0, 2.0], [0.0, 0.0, 1.0]])
    >>> camera = Camera(torch.eye(4), intrinsics, width=4, height=4)
    >>> distance_to_view(camera, torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, -3.0]])).tolist()
    [-3.5355..., 3.0]
    """
    right, down, ahead = camera.intrinsics
    limits = [(camera.width, right), (camera.height, down)]
    low = [-row - margin * size * ahead for size, row in limits]
    high = [row - (1 + margin) * size * ahead for size, row in limits]
    normals = torch.nn.functional.normalize(torch.stack((*low, *high, -ahead)), dim=1)
    planes = (normals @ camera.camera_from_world[:3]).to(points, non_blocking=True)
    return (points @ planes[:, :3].T + planes[:, 3]).amax(1)
