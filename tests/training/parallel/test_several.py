"""Several processes train the same bits as one that accumulates; a stop, a resume and a death among them."""

import os
import signal
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback

from sparsestreet.ranks import LostProcessError
from sparsestreet.training.lightning import begins_step
from sparsestreet.training.run import CPU_TRAINER
from tests.conftest import unchecked
from tests.training.parallel.several import several, trainers
from tests.training.parallel.street import IMAGES, train

pytestmark = pytest.mark.lengthy


@pytest.fixture(autouse=True, scope="module")
def quick() -> Iterator[None]:
    with unchecked():
        yield


class At(Callback):
    """Does something in one process, before a step."""

    def __init__(self, step: int, act: Any) -> None:
        self.step, self.act = step, act

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if trainer.global_step == self.step and begins_step(trainer, batch_idx):
            self.act()


def alone(size: int, folder: Path) -> dict[str, Any]:
    """One process that accumulates as many images."""
    return train(folder, partial(CPU_TRAINER, accumulate_grad_batches=size, limit_val_batches=0))


def assert_same_bits(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one["changes"] == other["changes"]
    assert one["parameters"].keys() == other["parameters"].keys()
    for name, value in one["parameters"].items():
        assert torch.equal(value, other["parameters"][name]), name


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    folder = tmp_path_factory.mktemp("two")
    return several(2, lambda rank: train(folder / "run", trainers(2)), folder)


@pytest.mark.parametrize("size", [2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)])
def test_several_processes_train_the_bits_of_one_that_accumulates(size, two, tmp_path):
    """Through densification, opacity resets, masks and both pruning rules. There is no tolerance: sums have the order
    in which one process adds up its images."""
    found = two if size == 2 else several(size, lambda rank: train(tmp_path / "run", trainers(size)), tmp_path)
    one = alone(size, tmp_path / "one")
    for answer in found:
        assert_same_bits(one, answer)
        assert (answer["steps"], answer["rates"]) == (one["steps"], one["rates"])
    assert one["steps"] == -(-IMAGES // size)
    # The images of a step, in turn; Lightning divides the loss of one that accumulates.
    shared = [image for step in zip(*(answer["images"] for answer in found), strict=True) for image in step]
    assert [index for index, _ in shared] == [index for index, _ in one["images"]]
    assert [loss for _, loss in shared] == pytest.approx([size * loss for _, loss in one["images"]], rel=1e-6)


def test_rows_come_and_go_for_every_reason(two):
    """Else the test above shows nothing."""
    changed = {(node, reason) for _, node, before, after, reason in two[0]["changes"] if before != after}
    assert {(node, "densify") for node in ("road", "cars", "people")} <= changed
    assert {("road", "mask"), ("people", "mask"), ("road", "pruning")} <= changed
    assert "opacity reset" in {reason for *_, reason in two[0]["changes"]}
    assert min(len(two[0]["parameters"][f"scene.nodes.{name}.rows.means"]) for name in ("road", "people")) > 5


def test_a_signal_to_one_stops_all_after_the_same_step_and_all_go_on_to_the_same_bits(two, tmp_path):
    """Between two refinements: each process has statistics of its own images."""

    def stopped_and_resumed(rank: int) -> Any:
        stop = [At(15, lambda: os.kill(os.getpid(), signal.SIGTERM))] if rank == 1 else []
        try:
            train(tmp_path, trainers(2), stop)
        except SystemExit:
            return "stopped"

    assert several(2, stopped_and_resumed, tmp_path) == ["stopped"] * 2
    checkpoint = tmp_path / "checkpoints" / "interrupted.ckpt"
    assert torch.load(checkpoint, weights_only=False)["global_step"] in (15, 16, 17)
    resumed = several(2, lambda rank: train(tmp_path, trainers(2), start=checkpoint), tmp_path)
    for before, after in zip(two, resumed, strict=True):
        for name, value in before["parameters"].items():
            assert torch.equal(value, after["parameters"][name]), name


@pytest.mark.slow
def test_one_that_accumulates_goes_on_to_the_same_bits(two, tmp_path):
    make = partial(CPU_TRAINER, accumulate_grad_batches=2, limit_val_batches=0)
    with pytest.raises(SystemExit):
        train(tmp_path, make, [At(15, lambda: os.kill(os.getpid(), signal.SIGTERM))])
    resumed = train(tmp_path, make, start=tmp_path / "checkpoints" / "interrupted.ckpt")
    for name, value in two[0]["parameters"].items():
        assert torch.equal(value, resumed["parameters"][name]), name


def test_a_process_that_is_killed_ends_the_others_with_one_sentence(tmp_path):
    killed = tmp_path / "killed"

    def die() -> None:
        killed.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)

    def until(rank: int) -> Any:
        try:
            return train(tmp_path, trainers(2), [At(10, die)] if rank == 1 else [])
        except LostProcessError as error:
            return str(error), time.time()

    (sentence, ended), nothing = several(2, until, tmp_path)
    assert nothing is None
    assert sentence.startswith("after step 10: one of the 2 processes that train together no longer answers process 0;")
    assert "\n" not in sentence
    assert ended - killed.stat().st_mtime < 30
