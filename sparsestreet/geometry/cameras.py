"""Projection and rays outside the splat op, through the lens where there is one: lidar coloring, visibility of seeds,
sky rays; and where the camera is, for both."""

from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.geometry.distortion import distort, fold_radius_squared, undistort
from sparsestreet.geometry.transforms import transform_points
from sparsestreet.types import Camera


def exact_position(camera: Camera) -> Float64[Tensor, "3"]:
    """The c in R (m - c) = R m + t, meters, in float64 whatever the pose's dtype.

    Solved for, so that it holds for a rotation that is orthonormal only to its dtype's last digit: over 20 km that
    digit of a float32 is 1 mm.
    """
    pose = camera.camera_from_world.detach().double()
    return torch.linalg.solve(pose[:3, :3], -pose[:3, 3])


def moved(camera: Camera, vector: Float64[Tensor, "3"]) -> Camera:
    """The camera elsewhere: moved in the world, meters, turned as it was."""
    pose = camera.camera_from_world.double().clone()
    pose[:3, 3] -= pose[:3, :3] @ vector
    return replace(camera, camera_from_world=pose.to(camera.camera_from_world.dtype))


def project(
    camera: Camera, points: Float[Tensor, "n 3"], near: float = 0.2
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Pixel coordinates, depth along the optical axis (meters) and whether each world point is in the image; on any
    device, while the camera is on the host. A point past the fold of a lens (``geometry.distortion``) is not."""
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
    """The 3x3 matrix, in float64, that takes a place (x, y, 1) in the image of a pinhole, pixels, to its direction in
    the world: R^T K^-1. The directions are not of unit length."""
    pose, ((fx, _, cx), (_, fy, cy), _) = camera.camera_from_world.tolist(), camera.intrinsics.tolist()
    columns = zip(*(row[:3] for row in pose[:3]), strict=True)
    return [[right / fx, down / fy, ahead - right * cx / fx - down * cy / fy] for right, down, ahead in columns]


def ray_directions(camera: Camera, device: torch.device | str = "cpu") -> Float[Tensor, "h w 3"]:
    """Unit directions in the world through the pixel centers, in the camera's dtype on a device.

    Those of a lens take a second or two per million pixels, once for all views of a camera. Raises ValueError where the
    lens has no inverse.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    image = ((fx, fy, cx, cy), camera.width, camera.height, camera.intrinsics.dtype, torch.device(device))
    if camera.distortion is None:
        in_camera = _pinhole_rays(*image)
    else:
        in_camera = _lens_rays(tuple(camera.distortion.tolist()), *image)
    in_world = in_camera @ camera.camera_from_world[:3, :3].to(device)
    return in_world / in_world.norm(dim=-1, keepdim=True)


def _pinhole_rays(
    intrinsics: tuple[float, ...], width: int, height: int, dtype: torch.dtype, device: torch.device
) -> Float[Tensor, "h w 3"]:
    """(x, y, 1) in the camera through the pixel centers; ``intrinsics`` are fx, fy, cx, cy."""
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
    """Meters by which world points lie outside of what a camera sees, at least; negative inside.

    What it sees ends at the sides of an image that is larger by ``margin`` of its size on each side, and at the camera.
    A lens and a shutter are left out: a margin makes up for what they show beyond. Waits for no device.
    """
    right, down, ahead = camera.intrinsics
    limits = [(camera.width, right), (camera.height, down)]
    low = [-row - margin * size * ahead for size, row in limits]
    high = [row - (1 + margin) * size * ahead for size, row in limits]
    normals = torch.nn.functional.normalize(torch.stack((*low, *high, -ahead)), dim=1)
    planes = (normals @ camera.camera_from_world[:3]).to(points)
    return (points @ planes[:, :3].T + planes[:, 3]).amax(1)
