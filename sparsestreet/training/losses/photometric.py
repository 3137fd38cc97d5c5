"""(1 - share) L1 + share (1 - SSIM) between the rendered and the recorded image (3DGS, eq. 7)."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from sparsestreet.ops.ssim import ssim
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@dataclass(frozen=True)
class Photometric:
    """On unclamped colors: a clamp would stop the gradient of saturated pixels (lamps, white sky)."""

    weight: float = 1.0
    lambda_dssim: float = 0.2

    def applies(self, frame: Frame) -> bool:
        return True

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        truth = frame.image.to(rendering.rgb.dtype) / 255
        error = (rendering.rgb - truth).abs().mean()
        if self.lambda_dssim > 0:
            error = (1 - self.lambda_dssim) * error + self.lambda_dssim * (1 - ssim(rendering.rgb, truth))
        return self.weight * error
