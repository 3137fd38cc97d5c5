"""How far an image moves behind its effects when the splats move a little."""

from collections.abc import Iterable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.effects.effect import Effect
from sparsestreet.types import View


@dataclass(frozen=True)
class LinearizedEffects:
    """A small change of the image: ``slope`` (d rgb - ``background`` d alpha), with rgb and alpha of the splats."""

    slope: Float[Tensor, "h w"] | None
    """None: 1."""
    background: Float[Tensor, "h w 3"] | None
    """None: black."""


def linearized(effects: Iterable[Effect], view: View) -> LinearizedEffects:
    """All effects of a scene in their order, for a view as its splats see it.

    With slopes s_k and backgrounds b_k, x_k = s_k x_(k-1) + (1 - alpha) b_k: together the product of all s_k, and the
    sum of b_k / (s_1 ... s_k).
    """
    slope = background = None
    for effect in effects:
        own, behind = effect.slope(view), effect.background(view)
        if own is not None:
            slope = own if slope is None else slope * own
        if behind is not None:
            light = behind if slope is None else behind / slope[..., None]
            background = light if background is None else background + light
    return LinearizedEffects(slope, background)
