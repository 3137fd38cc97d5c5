"""A scene seen through a mild lens, a moderate rolling shutter, both, or neither: what each effect costs."""

from dataclasses import replace
from typing import Literal

import torch

from sparsestreet.bench.scenes import BenchScene
from sparsestreet.types import Shutter

EffectsName = Literal["off", "lens", "shutter", "lens and shutter"]
EFFECTS: tuple[EffectsName, ...] = ("off", "lens", "shutter", "lens and shutter")
DISTORTION = (-0.05, 0.01, 5e-4, -5e-4, 0.0)
"""k1, k2, p1, p2, k3: a point 27 degrees off the axis moves inwards by 1.2 % of its distance from the center."""
TRANSLATION, ROTATION = (0.0, 0.0, 0.3), (0.0, 0.01, 0.0)
"""A readout of 30 ms in a car at 10 m/s that turns by 20 degrees a second: meters and radians, camera frame."""
WALK = 0.05
"""Standard deviation of each coordinate of the rows' own motion during the readout, meters: a brisk walk."""


def seen_through(scene: BenchScene, effects: EffectsName | None) -> BenchScene:
    """The scene with these effects instead of its camera's own; None: unchanged. Every call gives the same."""
    if effects is None:
        return scene
    like = scene.camera.intrinsics
    distortion = like.new_tensor(DISTORTION) if "lens" in effects else None
    shutter = Shutter(like.new_tensor(TRANSLATION), like.new_tensor(ROTATION)) if "shutter" in effects else None
    camera = replace(scene.camera, distortion=distortion, shutter=shutter)
    means = scene.gaussians.means
    walked = WALK * torch.randn(means.shape, generator=torch.Generator().manual_seed(0)).to(means)
    gaussians = replace(scene.gaussians, displacements=None if shutter is None else walked)
    return replace(scene, gaussians=gaussians, camera=camera)
