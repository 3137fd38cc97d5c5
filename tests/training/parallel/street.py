"""A training of a few Gaussians in which rows come and go for every reason, for one process or several."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lightning import Callback, Trainer
from torch import Tensor

from sparsestreet.data.datamodule import StreetData
from sparsestreet.pruning import ImportanceRule, LeaveOneOutRule
from sparsestreet.scene.density import DensityStatistics, GradientDensity
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import MaskScope, StaticMaskSettings, TemporalMaskSettings
from sparsestreet.scene.nodes import Background
from sparsestreet.training.callbacks import Checkpoints, DensityControl, GracefulStop, MaskTraining, Pruning
from sparsestreet.training.losses import MaskSparsity, Photometric
from sparsestreet.training.run import fit
from sparsestreet.training.schedule import Interval
from sparsestreet.training.system import StreetSystem
from tests.training.stubs import Listener, background, make_rows, make_system, rigid, street_data

IMAGES = 48
"""A multiple of two and three, so that one process and several end with the same image."""
STATIC = StaticMaskSettings(sparsity_weight=0.3, threshold=0.4, initial_logit=-0.2)
TEMPORAL = TemporalMaskSettings(sparsity_weight=0.3, threshold=0.4, frames=2, features=2, width=4, octaves=1)


class Watching(GradientDensity):
    """Asks how opacities are pulled, as PVG's strategy asks of life peaks."""

    watched = ("opacity_logits",)

    def urgency(self, statistics: DensityStatistics) -> Float[Tensor, " n"]:
        return statistics.mean_gradients("opacity_logits") / self.grad_threshold


class Images(Callback):
    """Which frame each batch had, and its loss."""

    def __init__(self) -> None:
        self.seen: list[tuple[int, float]] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        self.seen.append((batch.frame_index, float(outputs["loss"])))


def data() -> StreetData:
    """Seven images: no number of processes divides an epoch."""
    return street_data(7, stride=0)


def system() -> StreetSystem:
    torch.manual_seed(0)  # of the network of a mask
    density = GradientDensity(grad_threshold=2e-4)
    nodes = {
        "road": background(40, density=density, mask=STATIC, max_gaussians=150, limit_rises=False, min_gaussians=20),
        "cars": rigid(20, density=Watching(grad_threshold=1e-4), mask=STATIC, min_gaussians=9, box_margin=10.0),
        "people": _masked_over_time(
            background(
                24,
                seed=5,
                density=density,
                max_gaussians=60,
                limit_rises=False,
                min_gaussians=10,
                learning_rates=dict.fromkeys(("rows", "mask"), LearningRate(0.01)),
            )
        ),
    }
    return make_system(nodes, {"photometric": Photometric(), "masks": MaskSparsity(3.0)})


def _masked_over_time(node: Background) -> Background:
    mask = TEMPORAL.build(10, MaskScope.whole([0.0, 0.5, 1.0], torch.zeros(3), 4.0))
    return Background(node.settings, make_rows(24, 5, mask.initial_columns(24)), mask)


def train(
    folder: Path, make_trainer: Callable[..., Trainer], watch: Sequence[Callback] = (), start: Path | None = None
) -> dict[str, Any]:
    """Parameters, changes of rows, and what was seen at the end."""
    trained, changes, images = system(), Listener(), Images()
    callbacks = [
        DensityControl(
            Interval(0.0, 0.7, every=12), 0.5, Interval(0.4, 0.6, every=12), pause_after_reset=4, first_counts_all=True
        ),
        MaskTraining(Interval(0.0, 0.75, every=12)),
        Pruning([0.8], ImportanceRule()),
        Pruning([0.9], LeaveOneOutRule(allowed_db=0.05)),
        changes,
        images,
        Checkpoints(folder / "checkpoints", 1000),
        *watch,
        GracefulStop(),
    ]
    trainer = fit(trained, data(), callbacks, make_trainer, folder, max_steps=IMAGES, start=start)
    return {
        "parameters": {name: value.detach().clone() for name, value in trained.state_dict().items()},
        "changes": [(one.step, one.node, one.before, one.after, one.reason) for one, _ in changes.heard],
        "images": images.seen,
        "steps": trainer.global_step,
        "rates": [group["lr"] for group in trainer.optimizers[0].param_groups],
    }
