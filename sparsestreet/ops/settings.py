"""The knobs of the splat op: what is cut off, when a pixel stops, and how a splat is blurred."""

from dataclasses import dataclass
from math import inf
from typing import Literal

StopRule = Literal["inclusive", "exclusive"]


@dataclass(frozen=True)
class SplatSettings:
    """Cut-offs and filters of one rendering; the defaults are those of 3DGS with an inclusive stop.

    Raises ValueError for values outside the ranges given with each field.
    """

    alpha_min: float = 1 / 255
    """A splat does not touch a pixel where its alpha would be smaller; in [0, alpha_max). 0: no cut-off."""
    alpha_max: float = 0.99
    """Alpha is clamped here (gradient 0 above), in (0, 1): 1 / (1 - alpha) must stay finite."""
    transmittance_min: float = 1e-4
    """A pixel is finished when less light than this gets through, in [0, 1). 0: never."""
    stop: StopRule = "inclusive"
    """``inclusive``: the splat that crosses transmittance_min is still blended (error <= transmittance_min);
    ``exclusive``: it is dropped, as in 3DGS and gsplat."""
    eps2d: float = 0.3
    """Low-pass added to both diagonal entries of the screen covariance, px^2, >= 0 (3DGS, screen-space dilation)."""
    near_plane: float = 0.2
    """Rows at this depth or nearer are culled, meters, > 0."""
    max_sigma: float = inf
    """A splat ends this many standard deviations from its mean, > 0, besides at ``alpha_min`` (gsplat: 3.33)."""
    depth_bits: int = 32
    """Upper bits of the float32 depth that are sorted, 9 to 32 (9: powers of two of the depth). With fewer bits, rows
    of nearly equal depth are sorted by index."""
    half_colors: bool = False
    """Round colors to float16 before blending (gradient as if not rounded)."""
    antialias: bool = False
    """Multiply opacity by sqrt(det / det_blurred), so that blur does not brighten small splats (Mip-Splatting)."""

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
        """Settings by name; raises ValueError naming the presets there are.

        ``gsplat15``, ``gsplat16`` and ``inria`` match those renderers as far as these fields can say.
        """
        if name not in _PRESETS:
            raise ValueError(f"no settings preset {name!r}: choose one of {sorted(_PRESETS)}")
        return _PRESETS[name]


def _require(holds: bool, invariant: str, value: float | int | str) -> None:
    if not holds:
        raise ValueError(f"{invariant}, got {value!r}")


_PRESETS = {
    "default": SplatSettings(),
    # The clamp of alpha is part of the model, not a cut-off: it stays.
    "exact": SplatSettings(alpha_min=0.0, transmittance_min=0.0),
    "gsplat15": SplatSettings(alpha_max=0.999, stop="exclusive", near_plane=0.01),
    "gsplat16": SplatSettings(stop="exclusive", near_plane=0.01),
    "inria": SplatSettings(stop="exclusive"),
    # Splats end at 4 standard deviations instead of at an alpha: 20 dB and more nearer to "exact" than the default,
    # for little more time where stacks are shallow (docs/scaling.md).
    "fine": SplatSettings(alpha_min=0.0, max_sigma=4.0),
    # About 50 dB against "exact"; fewer pixels per splat and earlier stops.
    "fast": SplatSettings(alpha_min=1 / 128, transmittance_min=1e-3),
}
