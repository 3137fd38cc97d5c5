"""The LightningModule: render, sum the losses, log. What changes the scene's rows lives in callbacks."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from lightning import LightningModule
from torch import Tensor
from torch.optim import Optimizer
from torchmetrics.aggregation import RunningMean

from sparsestreet.evaluation.metrics.image import psnr
from sparsestreet.ops import SplatSettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering, render
from sparsestreet.training.losses import Loss
from sparsestreet.training.optimizer import OptimizerSettings
from sparsestreet.types import Frame


@dataclass(frozen=True)
class RenderOptions:
    """How training renders; evaluation takes the same."""

    settings: SplatSettings = field(default_factory=SplatSettings)
    backend: str = "auto"


class StreetSystem(LightningModule):
    """Trains a scene graph on single frames.

    ``rendering`` holds the newest training rendering between forward and the end of the batch; density control reads
    the screen gradients there. Whoever resizes rows sets it to None, so that no graph keeps the old parameters alive.
    """

    def __init__(
        self,
        scene: SceneGraph,
        losses: Mapping[str, Loss],
        optimization: OptimizerSettings,
        *,
        radius: float,
        options: RenderOptions = RenderOptions(),
        sh_interval: float = 1 / 30,
    ) -> None:
        super().__init__()
        self.scene = scene
        self.losses = dict(losses)
        self.optimization = optimization
        self.radius = radius
        self.options = options
        self.sh_interval = sh_interval
        """Fraction of the run after which one more degree of spherical harmonics is used."""
        self.rendering: SceneRendering | None = None
        self.train_psnr = RunningMean(window=100)

    def render(self, frame: Frame) -> SceneRendering:
        return render(
            self.scene, frame.camera, frame.time, settings=self.options.settings, backend=self.options.backend
        )

    def training_step(self, frame: Frame, index: int) -> Float[Tensor, ""]:
        self.scene.active_sh_degree = int(self._progress() / self.sh_interval)
        # Losses divide small numbers: they stay in float32 whatever the trainer's precision.
        with torch.autocast(self.device.type, enabled=False):
            self.rendering = self.render(frame)
            terms = {name: loss(self.rendering, frame) for name, loss in self.losses.items() if loss.applies(frame)}
        self._log_training(terms, frame)
        return torch.stack(tuple(terms.values())).sum()

    def validation_step(self, frame: Frame, index: int) -> None:
        with torch.autocast(self.device.type, enabled=False):
            image = self.render(frame).rgb.clamp(0, 1)
            value = psnr(image, frame.image.to(image.dtype) / 255)
        self.log("val/psnr", value, batch_size=1)

    def configure_optimizers(self) -> Optimizer:
        return self.optimization.build(self.scene, self.radius)

    def on_train_batch_start(self, batch: Frame, batch_idx: int) -> None:
        self.optimization.set_rates(self.trainer.optimizers[0], self._progress())

    def _progress(self) -> float:
        return self.global_step / max(self.trainer.max_steps, 1)

    def _log_training(self, terms: Mapping[str, Tensor], frame: Frame) -> None:
        """Running PSNR and the number of Gaussians in the progress bar, the terms in the log."""
        with torch.no_grad():
            image = self.rendering.rgb.detach().clamp(0, 1)
            self.train_psnr(psnr(image, frame.image.to(image.dtype) / 255))
        rows = float(sum(self.scene.counts().values()))
        self.log("psnr", self.train_psnr.compute(), batch_size=1)
        self.log("gaussians", rows, batch_size=1)
        self.log_dict({f"train/{name}": term.detach() for name, term in terms.items()}, batch_size=1)
