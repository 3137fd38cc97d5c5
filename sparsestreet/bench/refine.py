"""A trained street made finer: as many pairs in a tile of a larger image, from a scene that travels in little."""

import torch

from sparsestreet.bench.scenes import BenchScene
from sparsestreet.geometry.cameras import resized
from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.types import Gaussians


def refined(scene: BenchScene, factor: int, seed: int = 0) -> BenchScene:
    """Every splat replaced by ``factor`` x ``factor`` of a ``factor``-th of its size, seen in an image as much larger.

    The small ones lie where a normal distribution puts them: that of their splat, narrowed so that place and size
    together are as wide as the splat was. Equal for the same seed.

    Raises ValueError for a factor below 1.
    """
    if factor < 1:
        raise ValueError(f"a street is refined by a whole factor of at least 1, got {factor}")
    if factor == 1:
        return scene
    source = f"{scene.source}, refined {factor}x{factor}"
    camera = resized(scene.camera, factor * scene.camera.height, factor * scene.camera.width)
    return BenchScene(scene.name, source, _split(scene.gaussians, factor, seed), camera)


def enlarged(scene: BenchScene, factor: int) -> BenchScene:
    """The same splats in an image ``factor`` times as wide and high.

    Raises ValueError for a factor below 1.
    """
    if factor < 1:
        raise ValueError(f"an image is enlarged by a whole factor of at least 1, got {factor}")
    camera = resized(scene.camera, factor * scene.camera.height, factor * scene.camera.width)
    return BenchScene(scene.name, scene.source, scene.gaussians, camera)


def _split(gaussians: Gaussians, factor: int, seed: int) -> Gaussians:
    def repeated(field: torch.Tensor) -> torch.Tensor:
        return field.repeat_interleave(factor * factor, 0)

    scales, quaternions = repeated(gaussians.scales), repeated(gaussians.quaternions)
    drawn = torch.randn(scales.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(scales)
    # Variances add: (1 - 1 / factor^2) of places and 1 / factor^2 of sizes.
    offsets = (to_matrix(quaternions) @ ((1 - factor**-2) ** 0.5 * drawn * scales)[..., None])[..., 0]
    moved = gaussians.displacements
    return Gaussians(
        repeated(gaussians.means) + offsets,
        quaternions,
        scales / factor,
        repeated(gaussians.opacities),
        repeated(gaussians.sh),
        None if moved is None else repeated(moved),
    )
