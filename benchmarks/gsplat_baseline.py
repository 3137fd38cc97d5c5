"""gsplat on the same splats, timed and checked for parity; our settings match its semantics.

Written for gsplat 1.5.3, the newest release on PyPI, and 1.6, which is source only: it has exact ellipse-tile
intersection, the clamp at 0.99 and the kernel work of 2026. A comparison with 1.5.3 says nothing about those.
"""

import importlib
import re
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.bench.accuracy import Errors, answer, collect, errors
from sparsestreet.bench.timing import Cotangent, drop_gradients
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.types import Camera, Gaussians

MODES = ("packed", "unpacked")
"""The first keeps only rows in view, which takes less memory. Which one is faster depends on the view."""


def find_gsplat(device: torch.device) -> ModuleType | str:
    """Returns the module, or the reason why it cannot be timed here."""
    if device.type != "cuda":
        return "gsplat needs a CUDA device"
    try:
        return importlib.import_module("gsplat")
    except ImportError as error:
        return f"gsplat cannot be imported: {error}"


def version(module: ModuleType) -> str:
    """Its version, or "unknown"."""
    return getattr(module, "__version__", "unknown")


def settings_beside(module: ModuleType | None) -> SplatSettings:
    """Return the settings of our op in the comparison: clamp, stop rule and near plane of that version.

    Alpha ends at 0.999 up to 1.5 and at 0.99 from 1.6 on. Without a module, or a version: those of 1.5.
    """
    found = None if module is None else re.match(r"(\d+)\.(\d+)", version(module))
    is_newer = found is not None and (int(found[1]), int(found[2])) >= (1, 6)
    return SplatSettings.preset("gsplat16" if is_newer else "gsplat15")


def draw(
    module: ModuleType, gaussians: Gaussians, camera: Camera, packed: bool
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"], int]:
    """Color (premultiplied), alpha and the number of (splat, tile) pairs; ``packed`` trades time for memory."""
    colors, alphas, meta = _rasterization(module, gaussians, camera, packed)
    return colors[0], alphas[0, ..., 0], int(meta["flatten_ids"].shape[0])


def draw_for_training(
    module: ModuleType, gaussians: Gaussians, camera: Camera, mode: str
) -> tuple[Float[Tensor, "h w 3"], dict[str, Any]]:
    """Returns color, and what ``seen`` reads after the backward pass."""
    colors, _, meta = _rasterization(module, gaussians, camera, mode == "packed")
    return colors[0], meta


def seen(meta: dict[str, Any], rows: int) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
    """Absolute screen gradients and radii of all rows; in packed mode 0 for rows out of view."""
    gradients, radii = meta["means2d"].absgrad, meta["radii"].amax(-1).float()
    if gradients.dim() == 3:
        return gradients[0], radii[0]
    ids = meta["gaussian_ids"]
    whole, largest = gradients.new_zeros(rows, 2), gradients.new_zeros(rows)
    return whole.index_copy_(0, ids, gradients), largest.index_copy_(0, ids, radii)


def _rasterization(
    module: ModuleType, gaussians: Gaussians, camera: Camera, packed: bool
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Calls gsplat with ``absgrad``, because our op sums absolute screen gradients by default."""
    degree, settings = {1: 0, 4: 1, 9: 2, 16: 3}[gaussians.dense_sh().shape[1]], settings_beside(module)
    return module.rasterization(
        means=gaussians.means,
        quats=gaussians.quaternions,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colors=gaussians.dense_sh(),
        viewmats=camera.camera_from_world.to(gaussians.means)[None],
        Ks=camera.intrinsics.to(gaussians.means)[None],
        width=camera.width,
        height=camera.height,
        near_plane=settings.near_plane,
        eps2d=settings.eps2d,
        sh_degree=degree,
        packed=packed,
        absgrad=True,
        rasterize_mode="antialiased" if settings.antialias else "classic",
    )


def parity(module: ModuleType, rows: Gaussians, camera: Camera, backend: str) -> Errors:
    """gsplat's image and gradients against those of our ``backend``; leaves no gradient in ``rows``."""
    drop_gradients(rows)
    rgb, alpha, _ = draw(module, rows, camera, packed=False)
    Cotangent.of(camera, rows.means).backward(rgb, alpha)
    theirs = collect(rgb, rows)
    drop_gradients(rows)
    settings = settings_beside(module)
    return errors(theirs, answer(rows, camera, settings, backend, rows.means.dtype, rows.means.device.type))
