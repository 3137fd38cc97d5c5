"""The stub trainer against Lightning's: the same hooks in the same order at the same steps, the same numbers."""

from typing import Any

import torch
from lightning import Callback, Trainer

from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.training.callbacks import DensityControl, MaskTraining
from sparsestreet.training.schedule import Interval
from sparsestreet.training.system import StreetSystem
from tests.training.stubs import StubTrainer, background, fit, frame_at, make_system, set_rows

STEPS = 6


class Diary(Callback):
    """Which of the hooks that this project uses are called, at which step."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, int, bool]] = []

    def _note(self, hook: str, trainer: Trainer, system: StreetSystem) -> None:
        self.entries.append((hook, trainer.global_step, system.rendering is None))

    def setup(self, trainer: Trainer, pl_module: StreetSystem, stage: str) -> None:
        self._note("setup", trainer, pl_module)

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        self._note("start", trainer, pl_module)

    def on_after_backward(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        self._note("backward", trainer, pl_module)

    def on_train_batch_end(self, trainer: Trainer, pl_module: StreetSystem, *args: Any) -> None:
        self._note("end", trainer, pl_module)


def parts() -> tuple[StreetSystem, list[Callback], Diary]:
    """A training in which rows are split at steps 2 and 4, the masked go at 3, the mask at 5."""
    density = GradientDensity(grad_threshold=1e-4, split_scale=0.005)
    node = background(30, mask=StaticMaskSettings(1.0), density=density)
    set_rows(node, "mask_logits", {3: -9.0, 11: -9.0})
    never = Interval(0.0, 0.0)
    diary = Diary()
    callbacks = [
        DensityControl(Interval(0.0, 0.7, every=2), 0.7, never),
        MaskTraining(Interval(0.0, 5 / 6, every=3)),
        diary,
    ]
    return make_system({"background": node}), callbacks, diary


def test_lightning_and_the_stub_train_alike():
    frame = frame_at()
    system, callbacks, diary = parts()
    real = fit(system, callbacks, STEPS, frame)
    stub_system, stub_callbacks, stub_diary = parts()
    stub = StubTrainer(stub_system, stub_callbacks, max_steps=STEPS)
    stub.start()
    stub.train(STEPS, frame)
    assert stub_diary.entries == diary.entries
    theirs, ours = system.scene.state_dict(), stub_system.scene.state_dict()
    assert len(theirs["nodes.background.rows.means"]) > 30  # else nothing was asked
    assert "nodes.background.rows.mask_logits" not in theirs
    assert theirs.keys() == ours.keys()
    for name, value in theirs.items():
        assert torch.equal(value, ours[name]), name
    groups = [(group["rate"], len(group["params"])) for group in real.optimizers[0].param_groups]
    assert [(group["rate"], len(group["params"])) for group in stub.optimizers[0].param_groups] == groups
