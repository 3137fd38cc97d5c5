"""The sky behind an image: a cube map, read only where the sky shows (in a street, a fifth of the pixels).

It is fused, because a training step would otherwise dispatch a hundred small operations for it.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.geometry.cameras import ray_directions
from sparsestreet.ops.backend import disable_compile, fused_backend
from sparsestreet.ops.cpu import images as cpu
from sparsestreet.ops.cube_map import colors_along
from sparsestreet.ops.validate import check_camera
from sparsestreet.types import Camera


@disable_compile
def over_sky(
    rgb: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    texels: Float[Tensor, "6 r r 3"],
    camera: Camera,
    *,
    transmittance_min: float,
    backend: str = "auto",
) -> Float[Tensor, "h w 3"]:
    """Add the sky's color times the light 1 - alpha to ``rgb``, where that light is above ``transmittance_min``.

    Differentiable in ``rgb``, ``alpha`` and ``texels``, not in the camera. The sky is at infinity. A pixel sees it
    along its ray through the lens (``ray_directions``); the rolling shutter is ignored.

    Args:
        rgb: color premultiplied by alpha.
        alpha: coverage by everything in front of the sky.
        texels: a cube map (``cube_map``), r >= 1.
        camera: a camera of the image's size.
        transmittance_min: that of the splats' settings; below it a pixel is finished.
        backend: "torch", "cpu", "triton", or "auto" for the one that suits the tensors. With "cpu" the gradient of the
            texels is the same to the last bit in every run, for any number of threads; with "triton" it is not.

    Raises:
        ValueError: wrong shapes; several dtypes or devices; a camera that ``splat`` would refuse; an unknown backend,
            or tensors that it does not take.
        RuntimeError: the named backend is not built.

    >>> camera = Camera(torch.eye(4), torch.tensor([[2.0, 0, 1], [0, 2, 1], [0, 0, 1]]), width=2, height=2)
    >>> blue = torch.tensor([0.0, 0.0, 1.0]).expand(6, 1, 1, 3)
    >>> over_sky(torch.zeros(2, 2, 3), torch.full((2, 2), 0.75), blue, camera, transmittance_min=1e-4)[0, 0]
    tensor([0.0000, 0.0000, 0.2500])
    """
    check_camera(camera)
    _check(rgb, alpha, texels, camera)
    rgb, alpha, texels = rgb.contiguous(), alpha.contiguous(), texels.contiguous()
    chosen = fused_backend(backend, rgb, alpha, texels)
    if chosen == "cpu":
        return cpu.over_sky(rgb, alpha, texels, camera, transmittance_min)
    if chosen == "triton":
        from sparsestreet.ops.triton import sky as triton

        return triton.over_sky(rgb, alpha, texels, camera, transmittance_min)
    return _over_sky(rgb, alpha, texels, camera, transmittance_min)


def _over_sky(rgb: Tensor, alpha: Tensor, texels: Tensor, camera: Camera, transmittance_min: float) -> Tensor:
    transmittance = 1 - alpha.flatten()
    seen = torch.nonzero(transmittance > transmittance_min).squeeze(1)
    colors = colors_along(texels, ray_directions(camera, seen.device).reshape(-1, 3)[seen])
    light = transmittance[seen, None] * colors
    return rgb.reshape(-1, 3).index_add(0, seen, light).reshape(rgb.shape)


def _check(rgb: Tensor, alpha: Tensor, texels: Tensor, camera: Camera) -> None:
    side = max(1, *texels.shape[1:2])
    shapes = {"rgb": (camera.height, camera.width, 3), "alpha": (camera.height, camera.width)}
    tensors = {"rgb": rgb, "alpha": alpha, "texels": texels}
    for name, shape in (shapes | {"texels": (6, side, side, 3)}).items():
        given = tensors[name]
        if tuple(given.shape) != shape:
            raise ValueError(
                f"{name} must have shape {list(shape)} for an image of {camera.width}x{camera.height} pixels, got "
                f"{list(given.shape)}: give the camera that rendered it"
            )
        if given.dtype != rgb.dtype or given.device != rgb.device:
            raise ValueError(
                f"rgb, alpha and texels must share one dtype and device: rgb is {rgb.dtype} on {rgb.device}, {name} is "
                f"{given.dtype} on {given.device}; convert it with .to(rgb)"
            )
