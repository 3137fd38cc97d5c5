"""The LightningModule: render, sum the losses, log. What changes the scene's rows lives in callbacks."""

from collections import deque
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from lightning import LightningModule
from torch import Tensor
from torch.optim import Optimizer

from sparsestreet.metrics.image import psnr_on_device
from sparsestreet.metrics.reported import Psnr
from sparsestreet.phases import phase
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import DEFAULT_OPTIONS, RenderOptions, SceneRendering, render
from sparsestreet.scene.state import SceneState
from sparsestreet.training.far_depth import FarDepthTerm
from sparsestreet.training.lightning import (
    ends_step,
    image_number,
    images_per_step,
    logs_now,
    ranks_of,
)
from sparsestreet.training.losses import Loss, without_hood
from sparsestreet.training.moved_views import MovedViewTerm
from sparsestreet.training.nonfinite import LossWatch, Quarantine, SaidLater
from sparsestreet.training.optimizer import OptimizerSettings, set_rates
from sparsestreet.training.schedule import Course, ResolutionSchedule
from sparsestreet.types import Frame, View


class StreetSystem(LightningModule):
    """Trains a scene graph on single frames.

    ``rendering`` holds the newest training rendering between forward and the end of the batch; density control reads
    the screen gradients there. ``resize_rows`` and ``end_mask`` set it to None, so that no graph keeps the old
    parameters alive.
    """

    def __init__(
        self,
        scene: SceneGraph,
        losses: Mapping[str, Loss],
        optimizer: OptimizerSettings,
        *,
        radius: float,
        options: RenderOptions = DEFAULT_OPTIONS,
        sh_interval: float = 1 / 30,
        sh_every: int = 2,
        sh_every_from: float = 0.36,
        resolution: ResolutionSchedule | None = None,
        moved_views: MovedViewTerm | None = None,
        far_depth: FarDepthTerm | None = None,
    ) -> None:
        """Make a system of its parts.

        Args:
            scene: what is trained.
            losses: the terms by name, summed.
            optimizer: settings of Adam; the rates stand with the nodes.
            radius: of the scene, meters.
            options: how it is rendered.
            sh_interval: fraction of the run after which one more degree of spherical harmonics is used.
            sh_every: steps from one that moves the coefficients after the first to the next. They are three quarters of
                all numbers, of which Adam reads and writes 28 bytes each.
            sh_every_from: fraction of the run before which every step moves them.
            resolution: size of the images that steps train on; None: whole.
            moved_views: the terms of views beside the path; None: there are none.
            far_depth: the term of depths that images say; None: there is none.

        Raises:
            ValueError: if the interval is not positive, or harmonics would never move.
        """
        super().__init__()
        if not sh_interval > 0:
            raise ValueError(f"sh_interval must be > 0, got {sh_interval}: a tiny one uses all degrees from the start")
        if sh_every < 1 or not 0 <= sh_every_from <= 1:
            raise ValueError(
                "sh_every must be >= 1 step and sh_every_from a fraction of the run in [0, 1], got "
                f"{sh_every} and {sh_every_from}: sh_every=1 moves all coefficients in every step"
            )
        self.scene = scene
        self.losses = dict(losses)
        self.optimizer_settings = optimizer
        self.radius = radius
        self.options = options
        self.sh_interval = sh_interval
        self.sh_every, self.sh_every_from = sh_every, sh_every_from
        self.resolution = resolution or ResolutionSchedule()
        self.moved_views = moved_views
        self.far_depth = far_depth
        self.rendering: SceneRendering | None = None
        self.screen_gradients = False
        """Density control says for each step whether it needs them."""
        self.pixel_weights: Float[Tensor, "3 h w"] | None = None
        """Pruning says for each image whether its step finds out what ``render`` does with them."""
        self.quarantine = Quarantine()
        self.held_back: dict[str, int] = {}
        """Node -> Gaussians that were not added because memory had no room, over all refinements."""
        self._losses_seen = LossWatch()
        self._view: View | None = None
        """Of the step that is under way."""
        self._course: Course | None = None
        self.held_out_psnr = Psnr(("full", "human", "vehicle"))
        self.train_psnr: deque[Tensor] = deque(maxlen=10)
        self.said = SaidLater()
        """What training steps logged: PSNR, the terms, the number of Gaussians."""

    @property
    def course(self) -> Course:
        """How far the run has come at each step."""
        if self._course is None:
            self._course = Course(self.trainer.max_steps, images_per_step(self.trainer))
        return self._course

    def state(self, *, training: bool = False) -> SceneState:
        """Where training stands, for whoever renders the scene now."""
        progress = self.course.progress(self.global_step)
        # 0.6 / 0.2 is 2.9999999999999996.
        return SceneState(
            progress,
            int(progress / self.sh_interval + 1e-6),
            training,
            training and self.screen_gradients,
            self.global_step,
            training and progress >= self.sh_every_from and self.global_step % self.sh_every != 0,
        )

    def training_step(self, frame: Frame, index: int) -> Float[Tensor, ""]:
        state = self.state(training=True)
        if self.course.images_per_step > 1:
            for node in self.scene.nodes.values():
                if node.mask is not None:
                    node.mask.at_image(image_number(self.trainer, index))
        frame = self.resolution.of(frame, self.global_step, self.course)
        self.rendering = None  # else its tables, half a kilobyte a Gaussian, lie beside those of the new one
        # Losses divide small numbers: they stay in float32 whatever the trainer's precision.
        with torch.autocast(self.device.type, enabled=False):
            self.rendering = render(self.scene, frame, state, self.options, self.pixel_weights)
            # The splat op has waited for the device, so all that earlier steps said is on the host.
            self.said.pass_on(self.trainer)
            applicable = {name: loss for name, loss in self.losses.items() if loss.applies(frame)}
            terms = {}
            seen, recorded = without_hood(self.rendering, frame)
            for name, loss in applicable.items():
                with phase(f"loss {name}"):
                    terms[name] = loss(seen, recorded, self.scene)
            with phase("regularizers"):
                terms |= self.scene.regularizers(frame, self.rendering.parts, self.rendering.drawn, state)
            if self.far_depth is not None and self.far_depth.applies(frame):
                with phase("far depth"):
                    terms["far_depth"] = self.far_depth(self.rendering, frame)
            if self.moved_views is not None and self.moved_views.applies(state.step, state.progress):
                with phase("moved view"):
                    terms |= self.moved_views(self.scene, self.rendering, frame)
        values, self._view = torch.stack(tuple(terms.values())), frame
        self._losses_seen.look(terms, values, self.scene, self._view, self.global_step + 1)
        if logs_now(self.trainer):  # in other steps nothing is computed for the loggers
            with phase("logging"):
                self._log_training(self.rendering, terms, frame)
        return values.sum()

    def backward(self, loss: Tensor) -> None:
        with phase("backward"):
            loss.backward()

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Optimizer, optimizer_closure: Any = None) -> None:
        # The closure renders and differentiates: its phases take their own time out of this one.
        with phase("optimizer"):
            step = self.global_step + 1
            super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
            refused = getattr(self.trainer.optimizers[0], "refused", None)
            if refused is not None and self._view is not None:
                self.quarantine.look(refused, self.scene.named_parameters(), self._view, step)

    def on_validation_epoch_start(self) -> None:
        self.held_out_psnr.reset()

    def validation_step(self, frame: Frame, index: int) -> None:
        with torch.autocast(self.device.type, enabled=False):
            image = render(self.scene, frame, self.state(), self.options).rgb.clamp(0, 1)
            masks = {name: mask for name in ("human", "vehicle") if (mask := getattr(frame, name)) is not None}
            self.held_out_psnr.update(image, frame.image.to(image.dtype) / 255, masks)

    def on_validation_epoch_end(self) -> None:
        """Log the means over the images of all processes."""
        with ranks_of(self.trainer).answering():
            means = self.held_out_psnr.compute()
        for region, mean in means.items():
            self.log("val/psnr" if region == "full" else f"val/psnr_{region}", mean, batch_size=1)

    def configure_optimizers(self) -> Optimizer:
        return self.optimizer_settings.build(self.scene, self.radius, images_per_step(self.trainer))

    def on_train_batch_start(self, batch: Frame, batch_idx: int) -> None:
        set_rates(self.trainer.optimizers[0], self.state().progress)

    def on_train_batch_end(self, outputs: object, batch: Frame, batch_idx: int) -> None:
        if self.said.is_there and ends_step(self.trainer, batch_idx):
            self.said.pass_on(self.trainer)

    def on_validation_start(self) -> None:
        self.said.pass_on(self.trainer)

    def on_train_end(self) -> None:
        self.said.pass_on(self.trainer)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.said.pass_on(self.trainer)
        self.settle()
        checkpoint["held_back"] = dict(self.held_back)
        checkpoint["quarantined"] = self.quarantine.state_dict()
        checkpoint["train_psnr"] = [value.cpu() for value in self.train_psnr]

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.held_back = dict(checkpoint.get("held_back", {}))
        self.quarantine.load_state_dict(checkpoint.get("quarantined", {}))
        self.train_psnr.extend(value.to(self.device) for value in checkpoint.get("train_psnr", ()))

    def settle(self) -> None:
        """Look at what a device has said of the last step. Raises NotFiniteError."""
        self._losses_seen.settle()
        self.quarantine.settle()

    def _log_training(self, rendering: SceneRendering, terms: Mapping[str, Tensor], frame: Frame) -> None:
        """PSNR, over the last steps that logged, and the number of Gaussians for the progress bar; the terms."""
        image = rendering.rgb.detach().clamp(0, 1)
        self.train_psnr.append(psnr_on_device(image, frame.image.to(image.dtype) / 255))
        values = {"psnr": torch.stack(tuple(self.train_psnr)).mean()}
        values |= {f"train/{name}": term for name, term in terms.items()}
        self.said.say(self.trainer, values, {"gaussians": float(sum(self.scene.counts().values()))})
