"""Useless Gaussians planted in a trained street.

No setting yet finds nearly all of them and loses nearly nothing: masks alone spare what is visible and leave half of
the planted, the gate of background pruning takes also rows that would be missed (docs/results.md).
"""

import pytest
import torch
from jaxtyping import Bool
from lightning import Trainer
from torch import Tensor

from sparsestreet.cli.assemble import Assembly, assemble
from sparsestreet.cli.compose import load_run_config
from sparsestreet.cli.train import train
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.masks import StaticMask
from sparsestreet.scene.nodes.background import Background
from sparsestreet.training.callbacks import BackgroundPruning, MaskTraining
from sparsestreet.training.losses import MaskSparsity
from sparsestreet.training.optimizer import Optimization, Rate
from sparsestreet.training.schedule import Window
from tests.pruning.planted import Views, activated, judge, plant

STEPS = 600
FEW_VISIBLE = 300
"""Rows whose visibility is measured; each costs about one rendering of a few views."""


@pytest.fixture(scope="module")
def planted_street(tiny_street, tmp_path_factory):
    """A trained background, what was planted into it, and which of its own rows a view would miss."""
    out = tmp_path_factory.mktemp("planted")
    few = ("schedule.max_steps=300", "node=[background]", "scale.background.maximum_rows=2500")
    assert train([*tiny_street, f"hydra.run.dir={out}", *few]) == 0
    parts = _trained(out)
    cameras = [frame.camera for frame in parts.datamodule.split.train]
    generator = torch.Generator().manual_seed(0)
    background = parts.system.scene.nodes["background"]
    rows, planted = plant(background.rows, cameras, generator, hidden=60, copies=12, backend="cpu")
    sample = torch.randperm(int((~planted).sum()), generator=generator)[:FEW_VISIBLE]
    visible = Views(activated(rows), cameras, backend="cpu").visible(sample)
    return out, rows, planted, visible


def test_both_stages_find_what_was_planted(planted_street):
    """Measured recall 0.96 with one thread; the order of sums differs with threads, and 0.05 are 4 of 72 rows."""
    out, rows, planted, visible = planted_street
    keep = _prune(_trained(out), rows, mask_weight=20.0, gated=True)
    assert judge(keep, planted, visible).recall >= 0.9


def test_gentle_masks_leave_what_is_visible(planted_street):
    """Visible: moves a pixel of some view by more than 1/255 when it alone is removed. Measured 0.013."""
    out, rows, planted, visible = planted_street
    verdict = judge(_prune(_trained(out), rows, mask_weight=2.0, gated=False), planted, visible)
    assert verdict.visible_lost <= 0.02
    assert verdict.recall >= 0.3


def _trained(out) -> Assembly:
    parts = assemble(load_run_config(out))
    parts.system.load_state_dict(torch.load(out / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"])
    return parts


def _prune(parts: Assembly, rows: Rows, *, mask_weight: float, gated: bool) -> Bool[Tensor, " n"]:
    """Train on with masks, and with background pruning if ``gated``; which of the rows are left.

    A buffer of row numbers follows every plan.
    """
    mask = StaticMask(weight=2.5e-3, minimum_rows=200)
    columns = dict(rows.named_parameters()) | {"mask_logits": mask.initial_logits(len(rows))}
    node = Background(Rows(columns, {"numbers": torch.arange(len(rows))}), mask)
    system = parts.system
    system.scene.nodes["background"] = node
    system.losses["mask_sparsity"] = MaskSparsity(mask_weight)
    system.optimization = Optimization({**system.optimization.rates, "mask_logits": Rate(0.05)})
    trainer = Trainer(
        accelerator="cpu",
        max_steps=STEPS,
        max_epochs=-1,
        callbacks=[
            MaskTraining(Window(0.0, 0.8, 50)),
            *([BackgroundPruning([0.8], {"background": 200})] if gated else []),
        ],
        logger=False,
        enable_progress_bar=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        limit_val_batches=0,
        num_sanity_val_steps=0,
    )
    trainer.fit(system, datamodule=parts.datamodule)
    keep = torch.zeros(len(rows), dtype=torch.bool)
    keep[node.rows.numbers] = True
    return keep
