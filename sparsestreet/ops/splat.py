"""The one public signature of the op: Gaussians and a camera in, a differentiable Rendering out."""

from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.ops import reference
from sparsestreet.ops.backend import resolve_backend
from sparsestreet.ops.compiling import disable_compile
from sparsestreet.ops.cpu import rasterizer as cpu
from sparsestreet.ops.raster import Raster
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.validate import check_pixel_weights, check_structure
from sparsestreet.types import Camera, Contribution, Gaussians, LeaveOneOut, Rendering

DEFAULT_SETTINGS = SplatSettings()
_LEAST_ALPHA = 1e-6


@disable_compile
def splat(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Float[Tensor, "3"] | Float[Tensor, "h w 3"] | None = None,
    settings: SplatSettings = DEFAULT_SETTINGS,
    backend: str = "auto",
    screen_gradients: bool = True,
) -> Rendering:
    """Render 3D Gaussians (3DGS, Kerbl et al. 2023): project, sort by depth, blend front to back.

    Differentiable in every field of ``gaussians`` but ``displacements`` (in means also through the view direction of
    the colors) and in ``background``; not in the camera. Only once, but for "reference": torch refuses to
    differentiate a gradient of the other backends, or takes it, without a word, for a constant where the loss is linear
    in the image. Autocast has no effect here: everything runs in the dtype of the Gaussians, whatever the camera's. A
    graph of ``torch.compile`` breaks here, and the op runs as it is.

    Args:
        gaussians: n rows in the world, meters; n = 0 gives the background.
        camera: pinhole without skew, with its lens and rolling shutter where given (docs/effects.md).
        background: RGB behind everything, [3] or per pixel; None leaves rgb premultiplied by alpha. On a GPU its
            values are not looked at, which would be one more wait for the device: what is not finite shows in rgb.
        settings: cut-offs and filters.
        backend: "reference", "cpu", "triton" or "auto".
        screen_gradients: whether ``Rendering.screen_offsets`` gathers gradients; without, the pixel loop of Triton's
            backward pass takes 8 % fewer instructions.

    Raises:
        ValueError: wrong shapes, dtypes or devices; a camera whose pose is no rigid motion, whose size or lens is
            out of range; a value that is not finite, an opacity outside [0, 1] or a negative scale (named with field
            and row). Nothing but the opacity is looked at in a row whose opacity is 0, and the harmonics only of rows
            that are drawn (``Rendering.visible``): those of others may hold anything.
        RuntimeError: the backend asked for is not built.
        PairLimitError: the splats cover more tiles than can be held.
    """
    check_structure(gaussians, camera, background)
    chosen = resolve_backend(backend, gaussians.means.device)
    with torch.autocast(gaussians.means.device.type, enabled=False):
        offsets = _screen_offsets(gaussians, screen_gradients)
        raster = _module(chosen).rasterize(gaussians, offsets, camera, settings)
        return _compose(raster, offsets, background)


@disable_compile
def contribution(
    gaussians: Gaussians,
    camera: Camera,
    *,
    settings: SplatSettings = DEFAULT_SETTINGS,
    backend: str = "auto",
) -> Contribution:
    """What each row adds to one view: sum of blend weights, pixels touched, pixels dominated. No gradients.

    Raises as :func:`splat`.
    """
    check_structure(gaussians, camera, None)
    chosen = resolve_backend(backend, gaussians.means.device)
    with torch.no_grad(), torch.autocast(gaussians.means.device.type, enabled=False):
        return _module(chosen).contribution(gaussians, camera, settings)


@disable_compile
def leave_one_out(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Float[Tensor, "3"] | Float[Tensor, "h w 3"] | None = None,
    pixel_weights: Float[Tensor, "h w"] | None = None,
    settings: SplatSettings = DEFAULT_SETTINGS,
    backend: str = "auto",
) -> LeaveOneOut:
    """How far the view moves when each row alone is taken away, over a background (None: black). No gradients.

    ``pixel_weights``, finite and >= 0: how much the squared change of each pixel counts; None: 1.

    Exact for pixels that are not stopped: a pixel is linear in the alpha of each of its splats, so that the change is
    -alpha dC/dalpha. Where the stop rule hid splats behind, up to ``transmittance_min / (1 - alpha_max)`` of their
    light is missed.

    Raises as :func:`splat`, and ValueError for pixel weights out of range.
    """
    check_structure(gaussians, camera, background)
    chosen = resolve_backend(backend, gaussians.means.device)
    with torch.no_grad(), torch.autocast(gaussians.means.device.type, enabled=False):
        if pixel_weights is not None:
            check_pixel_weights(pixel_weights, camera, gaussians.means)
        behind = None if background is None else background.expand(camera.height, camera.width, 3)
        return _module(chosen).leave_one_out(gaussians, behind, pixel_weights, camera, settings)


def _module(backend: str) -> ModuleType:
    """Each checks values itself. Triton is imported only here, when it is first used."""
    if backend != "triton":
        return reference if backend == "reference" else cpu
    from sparsestreet.ops.triton import rasterizer

    return rasterizer


def _screen_offsets(gaussians: Gaussians, wanted: bool) -> Float[Tensor, "n 2"]:
    """A leaf of zeros; it takes part in the graph only where some field of the Gaussians does, and it is wanted."""
    fields = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.sh)
    wanted = wanted and torch.is_grad_enabled() and any(field.requires_grad for field in fields)
    offsets = gaussians.means.new_zeros(len(gaussians), 2)
    return offsets.requires_grad_() if wanted else offsets


def _compose(raster: Raster, offsets: Tensor, background: Tensor | None) -> Rendering:
    """Put the background behind the layers and turn the sum of depths into an expectation."""
    alpha = 1 - raster.transmittance
    rgb = raster.rgb
    if background is not None:
        rgb = rgb + raster.transmittance[..., None] * background
    depth = raster.depth_sum / alpha.clamp(min=_LEAST_ALPHA)
    return Rendering(rgb, alpha, depth, raster.radii, offsets)
