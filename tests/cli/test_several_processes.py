"""Methods of the command in several processes: the same bits as one process that accumulates (docs/scaling.md)."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from lightning import Trainer

from sparsestreet.cli.config.assemble import data_of, recipe_of, with_views
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.evaluation.speed import Timing
from sparsestreet.training.callbacks import RowLedger
from sparsestreet.training.parallel import DataParallel
from sparsestreet.training.run import CPU_TRAINER, build, fit, train
from tests.cli.configurations import composed
from tests.cli.conftest import TINY_NODES
from tests.cli.test_killed_sweep import content
from tests.training.parallel.several import several, trainers
from tests.typed import as_a


def trained(words: list[str], make_trainer: Callable[..., Trainer], folder: Path) -> dict[str, Any]:
    """What a training leaves in memory: parameters, changes of rows, losses by image."""
    cfg = composed(*words, f"folder={folder}")
    data = data_of(cfg)
    cfg = with_views(cfg, data)
    recipe = recipe_of(cfg)
    system, losses = build(recipe, data, recipe.plan(data)), []
    backward = system.backward
    system.backward = lambda loss: (losses.append(loss.item()), backward(loss))  # pyright: ignore
    fit(system, data, list(recipe.callbacks.values()), make_trainer, folder, max_steps=cfg.trainer.max_steps)
    changes = as_a(RowLedger, recipe.callbacks["row_ledger"]).changes
    return {"parameters": dict(system.state_dict()), "changes": changes, "losses": losses}


def test_ddp_is_an_option():
    cfg = composed("trainer=ddp", "trainer.devices=2")
    strategy = instantiate(cfg.trainer.strategy)
    assert type(strategy) is DataParallel
    assert (cfg.trainer.devices, cfg.trainer.accelerator, cfg.trainer.num_nodes) == (2, "auto", 1)
    assert cfg.optimizer.batch_rule == "sqrt"


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 4])
@pytest.mark.parametrize("method", ["streetgs", "omnire", "pvg"])
def test_methods_train_the_same_bits_in_several_processes(method, size, tiny_street, tmp_path):
    """Through densification, masks and removal. Each image's loss is that of one process, divided as there."""
    words = [
        *tiny_street,
        *TINY_NODES.get(method, []),
        f"method={method}",
        "sparsify=removal",
        "schedule.max_steps=160",
        "schedule.removal_db=0.01",
        "node.background.density.grad_threshold=1e-5",
        # Masks close within a few steps.
        "schedule.mask_learning_rate=0.3",
    ]
    one = trained(words, partial(CPU_TRAINER, accumulate_grad_batches=size, limit_val_batches=0), tmp_path / "one")
    assert {"start", "densify", "mask", "pruning"} <= {change.reason for change in one["changes"]}
    found = several(size, lambda rank: trained(words, trainers(size), tmp_path / f"{rank}"), tmp_path)
    assert [loss for step in zip(*(each["losses"] for each in found), strict=True) for loss in step] == one["losses"]
    for each in found:
        assert each["changes"] == one["changes"]
        for name, value in one["parameters"].items():
            assert torch.equal(value, each["parameters"][name]), name
    print(method, size, {c.node: c.after for c in one["changes"]}, one["losses"][0] * size, one["losses"][-1] * size)


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 3])
def test_several_processes_leave_the_records_of_one(size, tiny_street, tmp_path):
    """Validations, quality of all images, predictions, pictures: what one process that accumulates writes."""

    def run(out: Path, make_trainer: Callable[..., Trainer], val_check_interval: int) -> None:
        cfg = composed(*tiny_street, *TINY_NODES["streetgs"], "schedule.max_steps=120", f"folder={out}")
        data = data_of(cfg)
        cfg = with_views(cfg, data)
        train(
            recipe_of(cfg),
            data,
            out,
            max_steps=cfg.trainer.max_steps,
            make_trainer=partial(make_trainer, val_check_interval=val_check_interval, limit_val_batches=1.0),
            extra=ExtraMetrics(timing=Timing(1, 2, 1)),
        )

    run(tmp_path / "one/run", partial(CPU_TRAINER, accumulate_grad_batches=size), 10 * size)
    several(size, lambda rank: run(tmp_path / "several/run", trainers(size), 10), tmp_path)
    one, found = content(tmp_path / "one"), content(tmp_path / "several")
    assert {"run/predictions/held_out/005_0.png", "run/curves/held_out.csv"} <= one.keys()
    assert sorted(one) == sorted(found)
    # Losses of a step are those of the first process's image, and divided by the images of a step.
    one, found = ({name: value for name, value in each.items() if "metrics.csv" not in name} for each in (one, found))
    assert [name for name in one if one[name] != found[name]] == []
