"""A long training takes no more memory at its end than in its middle."""

import gc
import json
import statistics
from functools import partial
from pathlib import Path

import pytest
import torch
from lightning import Callback

from sparsestreet.cli import main
from sparsestreet.training.callbacks import RowLedger
from sparsestreet.training.run import CPU_TRAINER
from tests.cli.conftest import TINY_RIGID
from tests.stress.forked import Forked, resident_mb
from tests.training.parallel.street import train

STEPS = 20_000
EVERY = 50
MOST_MB = 6.0
"""Growth over the last 10,000 steps. One image of 64x40 kept a step would be 300 MB. What a run keeps by intent, its
curves, takes below 1 MB. The rest is the allocator's, whose blocks differ with every step."""


@pytest.mark.stress
def test_20000_steps_take_no_more_memory(tiny_street, tmp_path, monkeypatch):
    """Rows are born and removed in the first half; steps, validations and checkpoints go on to the end."""
    held: list[float] = []

    def look(self, trainer, *arguments):
        if trainer.global_step % EVERY == 0:
            held.append(resident_mb())

    words = ["train", *tiny_street, *TINY_RIGID, f"out={tmp_path / 'run'}", "sparsify=removal"]
    words += [f"schedule.max_steps={STEPS}", "trainer.val_check_interval=500", "checkpoint_every=1000"]
    words += ["schedule.refine_in.every=100", "schedule.mask_in.every=100", "trainer.log_every_n_steps=50"]

    def work() -> None:
        try:
            main(words)
        finally:
            (tmp_path / "held.json").write_text(json.dumps(held))

    monkeypatch.setattr(RowLedger, "on_train_batch_start", look, raising=False)
    ended = Forked(work, tmp_path / "log").join(limit=1200)
    assert ended.status == 0, ended.said
    found = json.loads((tmp_path / "held.json").read_text())
    assert len(found) == STEPS // EVERY
    quarters = [found[len(found) * part // 4 : len(found) * (part + 1) // 4] for part in range(4)]
    print("MB by quarter, median and most:", [(round(statistics.median(q), 1), round(max(q), 1)) for q in quarters])
    assert statistics.median(quarters[3]) - statistics.median(quarters[2]) < MOST_MB
    assert max(found[len(found) // 2 :]) - max(found[: len(found) // 2]) < MOST_MB


class Tensors(Callback):
    """Counts tensors that Python knows, at some steps."""

    def __init__(self, *steps: int) -> None:
        self.steps, self.counts = steps, []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if trainer.global_step in self.steps:
            gc.collect()
            self.counts.append(sum(isinstance(one, torch.Tensor) for one in gc.get_objects()))


@pytest.mark.lengthy
def test_the_short_form(tmp_path):
    """Tensors that a step keeps would be as many as steps; the optimizer has its own from the first on."""
    tensors = Tensors(40, 47)
    train(Path(tmp_path), partial(CPU_TRAINER, limit_val_batches=0), [tensors])
    before, after = tensors.counts
    assert after <= before
