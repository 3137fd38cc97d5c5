"""The public signatures of the op: it takes Gaussians and a camera, and returns a differentiable Rendering."""

from dataclasses import replace
from functools import cache
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.ops import reference
from sparsestreet.ops.backend import disable_compile, resolve_backend
from sparsestreet.ops.cpu import rasterizer as cpu
from sparsestreet.ops.raster import MIN_ALPHA, LeaveOneOutSums, Raster
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.validate import check_changes, check_gates, check_pixel_weights, check_structure
from sparsestreet.types import Camera, Contribution, Gaussians, Harmonics, LeaveOneOut, MedianDepth, Rendering

DEFAULT_SETTINGS = SplatSettings()


@disable_compile
def splat(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Float[Tensor, "3"] | Float[Tensor, "h w 3"] | None = None,
    settings: SplatSettings = DEFAULT_SETTINGS,
    backend: str = "auto",
    screen_gradients: bool = True,
    gates: Float[Tensor, " n"] | None = None,
    changes: LeaveOneOutSums | None = None,
    replay: bool = False,
) -> Rendering:
    """Render 3D Gaussians (3DGS, Kerbl et al. 2023): project, sort by depth, blend front to back.

    Differentiable in ``background``, in ``gates`` and in every field of ``gaussians`` except ``displacements``; not in
    the camera. The gradient of means includes that through the view direction of the colors.

    Only "reference" can be differentiated twice. With the other backends torch refuses, or silently treats the gradient
    as a constant if the loss is linear in the image. Autocast has no effect: everything runs in the dtype of the
    Gaussians, whatever the camera's. A graph of ``torch.compile`` breaks here, and the op runs uncompiled.

    Args:
        gaussians: n rows in the world, meters; n = 0 gives the background.
        camera: pinhole without skew, with lens and rolling shutter if given (docs/effects.md).
        background: RGB behind everything, [3] or per pixel; None leaves rgb premultiplied by alpha. On a GPU its values
            are not checked, which would wait for the device once more; values that are not finite show in rgb.
        settings: cut-offs and filters.
        backend: "reference", "cpu", "triton" or "auto".
        screen_gradients: whether ``Rendering.screen_offsets`` gets gradients. Without them the pixel loop of Triton's
            backward pass takes 8 % fewer instructions.
        gates: a factor M in [0, 1] of each row's alpha in every pixel, after the clamp (MaskGaussian, Liu et al. 2025);
            None: 1, at no cost. Rows are culled and listed as if all gates were 1. So a row whose gate is 0 changes no
            pixel and no other field's gradient, but is visible and its gate gets one: in each pixel
            dL/dM = alpha T (<dL/dC, c - b>), T the light that reaches it and b what is seen behind it. The stop rule
            sees gated alphas: rows behind the splat that finishes a pixel get none from there. On a GPU the values of
            gates are not checked, as those of a background.
        changes: is filled by the backward pass; images and gradients are the same bits without it. None: nothing is
            gathered, at no cost. Not with gates, which hide rows.
        replay: whether "triton" renders views of a kind that it has seen as CUDA graphs: the same bits, fewer calls of
            the host, and memory that stays. Views with gates or changes are drawn as ever; other backends launch
            nothing.

    Raises:
        ValueError: wrong shapes, dtypes or devices; a camera whose pose is not a rigid motion, or whose size or lens is
            out of range. Also for a value that is not finite, an opacity outside [0, 1] or a negative scale; the
            message names field and row. Rows of opacity 0 are not checked further. Harmonics are checked only in rows
            that are drawn (``Rendering.visible``).
        RuntimeError: the named backend is not built.
        PairLimitError: the splats cover more tiles than memory may hold.

    >>> one = torch.ones(1)
    >>> white = torch.full((1, 1, 3), 0.5 / 0.28209479)  # 0.5 + basis_0 sh_0 = 1
    >>> ball = Gaussians(torch.tensor([[0.0, 0.0, 2.0]]), torch.ones(1, 4), torch.full((1, 3), 0.2), 0.5 * one, white)
    >>> camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 4.5], [0, 20, 4.5], [0, 0, 1]]), width=9, height=9)
    >>> view = splat(ball, camera)
    >>> view.rgb[4, 4], view.depth[4, 4]  # at the mean, where alpha is the opacity
    (tensor([0.5000, 0.5000, 0.5000]), tensor(2.))
    """
    check_structure(gaussians, camera, background)
    chosen = resolve_backend(backend, gaussians.means.device)
    if gates is not None:
        check_gates(gates, gaussians.means)
    if changes is not None:
        check_changes(changes.pixel_weights, changes.background, gates, camera, gaussians.means)
    with torch.autocast(gaussians.means.device.type, enabled=False):
        offsets = _screen_offsets(gaussians, screen_gradients, filled=chosen != "triton")
        if chosen == "triton":
            return _module(chosen).render(gaussians, offsets, background, camera, settings, gates, changes, replay)
        raster = _module(chosen).rasterize(gaussians, offsets, camera, settings, gates=gates, changes=changes)
        return _compose(raster, offsets, background)


@disable_compile
def contribution(
    gaussians: Gaussians,
    camera: Camera,
    *,
    settings: SplatSettings = DEFAULT_SETTINGS,
    backend: str = "auto",
) -> Contribution:
    """Compute what each row adds to one view: sum of blend weights, pixels touched, pixels dominated. No gradients.

    Raises as :func:`splat` does.

    >>> means = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0]])
    >>> scales = torch.tensor([0.05, 0.4])[:, None].expand(2, 3)  # a small Gaussian in front of a large one
    >>> pair = Gaussians(means, torch.ones(2, 4), scales, torch.full((2,), 0.9), torch.zeros(2, 1, 3))
    >>> camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 4.5], [0, 20, 4.5], [0, 0, 1]]), width=9, height=9)
    >>> counts = contribution(pair, camera)
    >>> counts.pixels, counts.dominant
    (tensor([21, 81]), tensor([ 1, 80]))
    """
    check_structure(gaussians, camera, None)
    chosen = resolve_backend(backend, gaussians.means.device)
    with torch.no_grad(), torch.autocast(gaussians.means.device.type, enabled=False):
        return _module(chosen).contribution(gaussians, camera, settings)


@disable_compile
def median_depth(
    gaussians: Gaussians,
    camera: Camera,
    *,
    settings: SplatSettings = DEFAULT_SETTINGS,
    backend: str = "auto",
) -> MedianDepth:
    """Find the splat behind which at most half of the light passes, in each pixel. No gradients.

    A rendering's mean depth lies between the surfaces that a pixel mixes; this one is of a single splat (2DGS, Huang et
    al. 2024, median depth). Where pixels stop otherwise (``settings``) plays no part.

    Raises as :func:`splat` does.

    >>> means = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0]])
    >>> scales, opacities = torch.full((2, 3), 0.4), torch.tensor([0.4, 0.9])
    >>> pair = Gaussians(means, torch.ones(2, 4), scales, opacities, torch.zeros(2, 1, 3))
    >>> camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 4.5], [0, 20, 4.5], [0, 0, 1]]), width=9, height=9)
    >>> found = median_depth(pair, camera)
    >>> found.depth[4, 4], found.rows[4, 4]  # 0.6 of the light passes the first, 0.06 both
    (tensor(4.), tensor(1))
    """
    check_structure(gaussians, camera, None)
    chosen = resolve_backend(backend, gaussians.means.device)
    sh = gaussians.sh
    # Colors are not asked for, so one term of them is read.
    plain = replace(gaussians, sh=replace(sh, terms=1) if isinstance(sh, Harmonics) else sh[:, :1])
    halfway = replace(settings, transmittance_min=0.5, stop="inclusive")
    with torch.no_grad(), torch.autocast(gaussians.means.device.type, enabled=False):
        return _module(chosen).median_depth(plain, camera, halfway)


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
    """Compute how much the view changes when each row alone is removed, over a background (None: black). No gradients.

    ``pixel_weights``, finite and >= 0, multiply the squared change of each pixel; None: 1.

    Exact for pixels that are not stopped: a pixel is linear in the alpha of each of its splats, so the change is
    -alpha dC/dalpha. Where the stop rule hides splats, up to ``transmittance_min / (1 - alpha_max)`` of their light is
    missed.

    Raises as :func:`splat` does, and ValueError for pixel weights out of range.

    >>> one, black = torch.ones(1), torch.full((1, 1, 3), -0.5 / 0.28209479)
    >>> ball = Gaussians(torch.tensor([[0.0, 0.0, 2.0]]), torch.ones(1, 4), torch.full((1, 3), 0.2), 0.5 * one, black)
    >>> camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 4.5], [0, 20, 4.5], [0, 0, 1]]), width=9, height=9)
    >>> leave_one_out(ball, camera, background=torch.ones(3)).max_abs_change  # black of opacity 0.5 before white
    tensor([0.5000], dtype=torch.float64)
    """
    check_structure(gaussians, camera, background)
    chosen = resolve_backend(backend, gaussians.means.device)
    with torch.no_grad(), torch.autocast(gaussians.means.device.type, enabled=False):
        if pixel_weights is not None:
            check_pixel_weights(pixel_weights, camera, gaussians.means)
        behind = None if background is None else background.expand(camera.height, camera.width, 3)
        return _module(chosen).leave_one_out(gaussians, behind, pixel_weights, camera, settings)


def _module(backend: str) -> ModuleType:
    """The module of a backend, which checks values itself. Triton is imported only here, when it is first used."""
    if backend != "triton":
        return reference if backend == "reference" else cpu
    from sparsestreet.ops.triton import rasterizer

    return rasterizer


def _screen_offsets(gaussians: Gaussians, wanted: bool, filled: bool) -> Float[Tensor, "n 2"]:
    """A leaf of zeros. It is in the graph only if it is wanted and a field of the Gaussians is in the graph.

    ``filled``: whether it has memory of its own, for a backend that reads it; else all rows share one zero."""
    wanted = wanted and torch.is_grad_enabled() and any(field.requires_grad for field in gaussians.learned())
    means, shape = gaussians.means, (len(gaussians), 2)
    offsets = means.new_zeros(shape) if filled else _zero(means.dtype, means.device).expand(shape)
    return offsets.requires_grad_() if wanted else offsets


@cache
@torch.inference_mode(False)
def _zero(dtype: torch.dtype, device: torch.device) -> Float[Tensor, ""]:
    return torch.zeros((), dtype=dtype, device=device)


def _compose(raster: Raster, offsets: Tensor, background: Tensor | None) -> Rendering:
    """Add the background and turn the sum of depths into an expectation."""
    alpha = 1 - raster.transmittance
    rgb = raster.rgb
    if background is not None:
        rgb = rgb + raster.transmittance[..., None] * background
    depth = raster.depth_sum / alpha.clamp(min=MIN_ALPHA)
    return Rendering(rgb, alpha, depth, raster.radii, offsets)
