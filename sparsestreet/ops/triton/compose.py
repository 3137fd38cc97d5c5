"""The last step of a rendering and the first of its gradient: background, alpha and expected depth of each pixel.

The same bits as ops/splat.py computes by torch, which takes five passes over the image, and eight back.
"""

from dataclasses import dataclass
from functools import partial

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from sparsestreet.ops.raster import LEAST_ALPHA
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.launch import launch

_BLOCK = 512
_OPTIONS = {"enable_fp_fusion": False}
LEAST = constant(LEAST_ALPHA)


@dataclass(frozen=True)
class Composed:
    """What backward needs of a composed image."""

    transmittance: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    background: Float[Tensor, "..."] | None
    """[3] or [h, w, 3]."""


def compose(
    rgb: Float[Tensor, "h w 3"],
    transmittance: Float[Tensor, "h w"],
    depth_sum: Float[Tensor, "h w"],
    background: Float[Tensor, "..."] | None,
) -> Float[Tensor, "h w"]:
    """Returns alpha; puts the background behind ``rgb`` and turns ``depth_sum`` into a depth, both in place."""
    alpha = torch.empty_like(transmittance)
    launch(
        compose_pixels, alpha.numel(), _BLOCK,
        rgb, transmittance, depth_sum, rgb if background is None else background, alpha, alpha.numel(),
        **_behind(background), options=_OPTIONS,
    )  # fmt: skip
    return alpha


def decompose(
    composed: Composed, v_rgb: Tensor, v_alpha: Tensor | None, v_depth: Tensor | None, background_too: bool
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Gradients of the transmittance, of the sum of depths (None: none was asked for), and of the background."""
    passed, background = composed.transmittance, composed.background
    if v_alpha is None and v_depth is None and background is None:
        return torch.zeros_like(passed), None, None
    v_passed, v_background = torch.empty_like(passed), torch.empty_like(v_rgb) if background_too else None
    v_depth_sum = None if v_depth is None else torch.empty_like(passed)
    unread = [passed if given is None else given for given in (v_alpha, v_depth, background, v_background, v_depth_sum)]
    launch(
        decompose_pixels, passed.numel(), _BLOCK,
        passed, composed.depth, v_rgb, *unread, v_passed, passed.numel(),
        ALPHA=v_alpha is not None, DEPTH=v_depth is not None, COLORS=background_too, **_behind(background),
        options=_OPTIONS,
    )  # fmt: skip
    if v_background is not None and background is not None and background.dim() == 1:
        v_background = v_background.sum((0, 1))
    return v_passed, v_depth_sum, v_background


def _behind(background: Tensor | None) -> dict[str, int]:
    """How far the colors of two pixels lie apart; -1: there is no background."""
    return {"APART": -1 if background is None else 3 * (background.dim() == 3)}


@partial(jit, do_not_specialize=["pixels"])
def compose_pixels(
    rgb, transmittance, depth_sum, background, alpha, pixels, APART: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = pixel < pixels
    passed = tl.load(transmittance + pixel, given, 1.0)
    opaque = 1 - passed
    tl.store(alpha + pixel, opaque, given)
    depth = tl.div_rn(tl.load(depth_sum + pixel, given, 0.0), tl.maximum(opaque, LEAST))
    tl.store(depth_sum + pixel, depth, given)
    if APART >= 0:
        for i in tl.static_range(3):
            behind = tl.load(background + APART * pixel + i, given, 0.0)
            at = rgb + 3 * pixel + i
            tl.store(at, tl.load(at, given, 0.0) + passed * behind, given)


@partial(jit, do_not_specialize=["pixels"])
def decompose_pixels(
    transmittance, depths, v_rgb, v_alphas, v_depths, background, v_background, v_depth_sum, v_transmittance, pixels,
    ALPHA: tl.constexpr, DEPTH: tl.constexpr, COLORS: tl.constexpr, APART: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """In the order in which torch adds and divides."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = pixel < pixels
    passed = tl.load(transmittance + pixel, given, 1.0)
    opaque, v_opaque = 1 - passed, tl.zeros_like(passed)
    if ALPHA:
        v_opaque = tl.load(v_alphas + pixel, given, 0.0)
    if DEPTH:
        v_depth, least = tl.load(v_depths + pixel, given, 0.0), tl.maximum(opaque, LEAST)
        tl.store(v_depth_sum + pixel, tl.div_rn(v_depth, least), given)
        through = -v_depth * tl.div_rn(tl.load(depths + pixel, given, 0.0), least)
        v_opaque += tl.where(opaque >= LEAST, through, 0.0)
    v_passed = -v_opaque
    if APART >= 0:
        through = tl.zeros_like(passed)
        for i in tl.static_range(3):
            color = tl.load(v_rgb + 3 * pixel + i, given, 0.0)
            through += color * tl.load(background + APART * pixel + i, given, 0.0)
            if COLORS:
                tl.store(v_background + 3 * pixel + i, color * passed, given)
        v_passed += through
    tl.store(v_transmittance + pixel, v_passed, given)
