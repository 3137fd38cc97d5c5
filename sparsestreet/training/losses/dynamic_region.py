"""What shows moving objects weighs more towards the end of a run (DriveStudio's paper_legacy configurations)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.ops import splat
from sparsestreet.ops.activate import activate
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@dataclass(frozen=True)
class DynamicRegion:
    """Mean |I - truth| once more over the pixels that objects cover: where they, rendered alone, have enough alpha.

    Objects are what nodes with ``instances`` hold. What stands in front of them does not count: a hidden object has its
    region too. Rendered once more without gradients, and only from ``from_progress`` on; 0 before, and in views
    without objects.
    """

    weight: float = 1.0
    threshold: float = 0.2
    """Alpha of the objects above which a pixel belongs to the region."""
    from_progress: float = 0.6666
    """Fraction of the run before which the term rests."""

    def applies(self, frame: Frame) -> bool:
        return True

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        objects = [rendering.parts[name] for name, node in scene.nodes.items() if node.instances() is not None]
        if not objects or rendering.state.progress < self.from_progress:
            return torch.zeros((), device=rendering.rgb.device)
        with torch.no_grad():
            # Of no interest in which colors.
            gaussians, options = activate(objects, sh_degree=0), rendering.options
            camera = scene.seen(frame, rendering.state).camera
            alone = splat(gaussians, camera, settings=options.settings, backend=options.backend)
        region = alone.alpha > self.threshold
        if frame.ego is not None:
            region = region & ~frame.ego
        error = (rendering.rgb - frame.image.to(rendering.rgb.dtype) / 255).abs().mean(-1)
        # Over all pixels, because picking those of the region would wait for a device.
        return self.weight * (torch.where(region, error, 0.0).sum() / region.sum().clamp(min=1))
