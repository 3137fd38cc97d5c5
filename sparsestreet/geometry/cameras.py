"""The pinhole projection outside the splat op: lidar coloring, visibility of seeds, box masks, sky rays; and where
the camera is, for both."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

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
    device, while the camera is on the host."""
    in_camera = transform_points(camera.camera_from_world.to(points), points)
    depth = in_camera[:, 2]
    safe = depth.clamp(min=near)
    pixels = (in_camera @ camera.intrinsics.to(points).T)[:, :2] / safe[:, None]
    inside = (depth > near) & (pixels >= 0).all(-1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    return pixels, depth, inside


def ray_matrix(camera: Camera) -> list[list[float]]:
    """The 3x3 matrix, in float64, that takes a place (x, y, 1) in the image of a pinhole, pixels, to its direction in
    the world: R^T K^-1. The directions are not of unit length."""
    pose, ((fx, _, cx), (_, fy, cy), _) = camera.camera_from_world.tolist(), camera.intrinsics.tolist()
    columns = zip(*(row[:3] for row in pose[:3]), strict=True)
    return [[right / fx, down / fy, ahead - right * cx / fx - down * cy / fy] for right, down, ahead in columns]


def ray_directions(camera: Camera, device: torch.device | str = "cpu") -> Float[Tensor, "h w 3"]:
    """Unit directions in the world through the pixel centers, in the camera's dtype on a device."""
    like = {"dtype": camera.intrinsics.dtype, "device": device}
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    x = (torch.arange(camera.width, **like) + 0.5 - cx) / fx
    y = (torch.arange(camera.height, **like) + 0.5 - cy) / fy
    y, x = torch.meshgrid(y, x, indexing="ij")
    in_camera = torch.stack((x, y, torch.ones_like(x)), dim=-1)
    in_world = in_camera @ camera.camera_from_world[:3, :3].to(device)
    return in_world / in_world.norm(dim=-1, keepdim=True)


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
