"""The points of the sweep: one knob at a time around the default, the presets, effects, tile sizes and backends."""

from dataclasses import dataclass, replace
from math import inf

import torch

from sparsestreet.bench.effects import EFFECTS, EffectsName
from sparsestreet.bench.tile_sizes import TILE_SIZES
from sparsestreet.ops.settings import SplatSettings

DEFAULT = SplatSettings()
PRESETS = ("default", "exact", "gsplat15", "gsplat16", "inria", "fast", "fine")
KNOBS: dict[str, tuple[float | int | bool | str, ...]] = {
    "alpha_min": (0.0, 1 / 1024, 1 / 512, 1 / 255, 1 / 128, 1 / 64),
    "max_sigma": (3.0, 3.33, 4.0, inf),
    "transmittance_min": (1e-5, 1e-4, 1e-3, 1e-2),
    "stop": ("inclusive", "exclusive"),
    "eps2d": (0.0, 0.1, 0.3),
    "half_colors": (False, True),
    "depth_bits": (12, 16, 24, 32),
}
"""Fields of SplatSettings and their values."""
BOXES_ALONE = (3.0, 3.33, 4.0)
"""Values of max_sigma without alpha_min. Either bounds a splat, so each would hide what the other costs."""
STOPS_EARLIER = (1e-3, 1e-2)
"""Values of transmittance_min for the exclusive stop; KNOBS has them for the inclusive stop.

The exclusive stop may lose transmittance_min / (1 - alpha_max) of a pixel's light, the inclusive one transmittance_min.
"""
BACKENDS = (("cpu", torch.float64), ("reference", torch.float32), ("triton", torch.float32))
"""The backends besides C++ in float32, which times all other points."""
FIXED = {
    ("tile size", "reference"): "dense: it has no tiles",
    ("tile size", "triton"): "compiled for tiles of 16x16",
    ("exact tiles", "cpu"): "always exact; that this changes no pixel is measured as 'culling'",
    ("exact tiles", "reference"): "dense: it has no tiles",
    ("exact tiles", "triton"): "always exact",
    ("dot precision", "cpu"): "no backend has a matrix product in its blend",
    ("dot precision", "reference"): "a truth: matrix products in the dtype of the Gaussians",
    ("dot precision", "triton"): "no backend has a matrix product in its blend",
}
"""Choices that a backend fixes: (knob, backend) -> what holds instead."""


@dataclass(frozen=True)
class Point:
    """One configuration to time."""

    knob: str
    """The knob that is not at its default; ``default``, ``preset`` and ``backend`` for the rest."""
    value: str
    settings: SplatSettings
    preset: str | None = None
    """Name of the preset that has these settings."""
    backend: str = "cpu"
    dtype: torch.dtype = torch.float32
    tile: int | None = None
    """Side of the tiles, pixels, for which the C++ library is compiled; None: the library in use."""
    effects: EffectsName | None = None
    """Lens and shutter that replace those of the scene's camera; None: its own."""

    @property
    def other_model(self) -> bool:
        """Whether the image differs on purpose: blur, clamp, compensation, lens and shutter change the model."""
        return _model(self.settings) != _model(DEFAULT) or self.effects not in (None, "off")

    @property
    def exact(self) -> SplatSettings:
        """Settings of this point's own model without cut-offs: R0."""
        blur, alpha_max, antialias = _model(self.settings)
        exact = SplatSettings.preset("exact")
        return replace(exact, eps2d=blur, alpha_max=alpha_max, antialias=antialias, near_plane=self.settings.near_plane)

    @property
    def same_cutoffs(self) -> SplatSettings:
        """Settings with this point's cut-offs, without its rounding of colors and depths: R1."""
        return replace(self.settings, half_colors=False, depth_bits=32)


def points() -> list[Point]:
    """All points: the default, every knob, presets that no knob reaches, effects, tile sizes and the other backends.

    The tile sizes include that of the library in use, because a separate process may cost something."""
    effects = [Point("effects", name, DEFAULT, effects=name) for name in EFFECTS]
    tiles = [Point("tile size", str(size), DEFAULT, tile=size) for size in TILE_SIZES]
    return [*_points_of_settings(), *effects, *tiles, *backend_points()]


def backend_points() -> list[Point]:
    """The default's settings on the other backends and in other precision."""
    return [
        Point("backend", f"{name} {str(dtype).removeprefix('torch.')}", DEFAULT, backend=name, dtype=dtype)
        for name, dtype in BACKENDS
    ]


def _points_of_settings() -> list[Point]:
    named = {name: SplatSettings.preset(name) for name in PRESETS}
    swept = [Point("default", "default", DEFAULT)]
    for knob, values in KNOBS.items():
        changed = [(value, replace(DEFAULT, **{knob: value})) for value in values]
        swept += [Point(knob, _text(knob, value), settings) for value, settings in changed if settings != DEFAULT]
    swept += [
        Point("box alone", _text("max_sigma", box), replace(DEFAULT, alpha_min=0.0, max_sigma=box))
        for box in BOXES_ALONE
    ]
    swept += [
        Point("exclusive stop", f"at {least:g}", replace(DEFAULT, stop="exclusive", transmittance_min=least))
        for least in STOPS_EARLIER
    ]
    met = [point.settings for point in swept]
    swept += [Point("preset", name, settings) for name, settings in named.items() if settings not in met]
    names = {settings: name for name, settings in reversed(named.items())}
    return [replace(point, preset=names.get(point.settings)) for point in swept]


def _model(settings: SplatSettings) -> tuple[float, float, bool]:
    return settings.eps2d, settings.alpha_max, settings.antialias


def _text(knob: str, value: float | int | bool | str) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"1/{round(1 / value)}" if knob == "alpha_min" and value else f"{value:g}"
