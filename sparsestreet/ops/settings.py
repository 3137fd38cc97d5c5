"""The knobs of the splat op: cut-offs, when a pixel stops, and how a splat is blurred."""

from dataclasses import dataclass
from math import inf
from typing import Literal

StopRule = Literal["inclusive", "exclusive"]


@dataclass(frozen=True)
class SplatSettings:
    """Cut-offs and filters of one rendering; the defaults are those of 3DGS with an inclusive stop.

    Raises ValueError for values outside the ranges given with each field.

    >>> SplatSettings(eps2d=0.1).eps2d, SplatSettings.preset("gsplat15").alpha_max
    (0.1, 0.999)
    >>> SplatSettings(alpha_max=1.0)
    Traceback (most recent call last):
    ValueError: alpha_max must lie in (0, 1), got 1.0
    """

    alpha_min: float = 1 / 255
    """A splat leaves out pixels where its alpha would be smaller; in [0, alpha_max). 0: no cut-off."""
    alpha_max: float = 0.99
    """Alpha is clamped to this (gradient 0 above), in (0, 1), because 1 / (1 - alpha) must stay finite."""
    transmittance_min: float = 1e-4
    """A pixel is finished when less light than this passes, in [0, 1). 0: never."""
    stop: StopRule = "inclusive"
    """``inclusive``: the splat that crosses transmittance_min is still blended (error <= transmittance_min);
    ``exclusive``: it is dropped, as in 3DGS and gsplat."""
    eps2d: float = 0.3
    """Low-pass added to both diagonal entries of the screen covariance, px^2, >= 0 (3DGS, screen-space dilation)."""
    near_plane: float = 0.2
    """Rows at this depth or nearer are culled, meters, > 0."""
    max_sigma: float = inf
    """A splat ends this many standard deviations from its mean, or at ``alpha_min`` if nearer, > 0 (gsplat: 3.33)."""
    depth_bits: int = 32
    """Number of upper bits of the float32 depth that are sorted, 9 to 32 (9: powers of two of the depth).

    With fewer bits, rows of nearly equal depth are drawn in the order of their index."""
    half_colors: bool = False
    """Round colors to float16 before blending (gradient as if not rounded)."""
    antialias: bool = False
    """Multiply opacity by sqrt(det / det_blurred), so that blur does not brighten small splats (Mip-Splatting)."""
    clamp_colors: bool = False
    """Clamp colors to [0, 1] (gradient 0 outside). Without it they are only kept from falling below 0."""
    detach_directions: bool = False
    """Means get no gradient through the direction in which their colors are seen."""
    plain_gradients: bool = False
    """``Rendering.screen_offsets`` gathers gradients as they are, as in 3DGS. False: their absolute values (AbsGS)."""

    def __post_init__(self) -> None:
        _require(0 < self.alpha_max < 1, "alpha_max must lie in (0, 1)", self.alpha_max)
        _require(0 <= self.alpha_min < self.alpha_max, "alpha_min must lie in [0, alpha_max)", self.alpha_min)
        _require(0 <= self.transmittance_min < 1, "transmittance_min must lie in [0, 1)", self.transmittance_min)
        _require(self.stop in ("inclusive", "exclusive"), "stop must be 'inclusive' or 'exclusive'", self.stop)
        _require(0 <= self.eps2d < float("inf"), "eps2d must be finite and >= 0 px^2", self.eps2d)
        _require(self.max_sigma > 0, "max_sigma must be > 0 standard deviations", self.max_sigma)
        _require(9 <= self.depth_bits <= 32, "depth_bits must lie in [9, 32]", self.depth_bits)
        _require(0 < self.near_plane < float("inf"), "near_plane must be finite and > 0 m", self.near_plane)

    @staticmethod
    def preset(name: str) -> "SplatSettings":
        """Return settings by name; raise ValueError with the names of all presets.

        ``gsplat15``, ``gsplat16``, ``inria`` and ``drivestudio`` match those renderers as far as these fields allow.
        """
        if name not in _PRESETS:
            raise ValueError(f"no settings preset {name!r}: choose one of {sorted(_PRESETS)}")
        return _PRESETS[name]


OWN_PRESETS = ("default", "exact", "fine", "fast")
"""They choose cut-offs alone, so a scene is drawn with antialias or without as it was trained. The others are models of
other renderers, none of which has it."""


def _require(holds: bool, invariant: str, value: float | int | str) -> None:
    if not holds:
        raise ValueError(f"{invariant}, got {value!r}")


_PRESETS = {
    "default": SplatSettings(),
    # The clamp of alpha stays, because it is part of the model, not a cut-off.
    "exact": SplatSettings(alpha_min=0.0, transmittance_min=0.0),
    "gsplat15": SplatSettings(alpha_max=0.999, stop="exclusive", near_plane=0.01),
    "gsplat16": SplatSettings(stop="exclusive", near_plane=0.01),
    "inria": SplatSettings(stop="exclusive"),
    # gsplat 1.3.0 as DriveStudio (e59bda4) calls it: it gives gsplat colors in [0, 1], seen from detached means.
    "drivestudio": SplatSettings(
        alpha_max=0.999, stop="exclusive", near_plane=0.1, clamp_colors=True, detach_directions=True
    ),
    # Splats end at 4 standard deviations instead of at an alpha. This is at least 20 dB nearer to "exact" than the
    # default, and takes little more time where stacks are shallow (docs/scaling.md).
    "fine": SplatSettings(alpha_min=0.0, max_sigma=4.0),
    # About 50 dB against "exact", with fewer pixels per splat and earlier stops.
    "fast": SplatSettings(alpha_min=1 / 128, transmittance_min=1e-3),
}
