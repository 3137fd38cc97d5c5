"""Growth that memory holds back: how much, that it is said, and that nothing else changes."""

import logging

import pytest
import torch

from sparsestreet.ranks import Ranks
from sparsestreet.scene.density import GradientDensity
from sparsestreet.training.callbacks import DensityControl, density_control
from sparsestreet.training.forecast import bytes_of_row
from sparsestreet.training.system import StreetSystem
from tests.training.callbacks.refining import every_ten, started
from tests.training.stubs import Listener, background

GROWS_ALL = GradientDensity(grad_threshold=1e-12, cull_opacity=0.0, cull_scale=1e9)
EACH = bytes_of_row(background(1).rows, moved=False)
"""Bytes of one more Gaussian, as ``test_memory.py`` compares them with what a step allocates."""


def grown(monkeypatch: pytest.MonkeyPatch, *free: float) -> tuple[DensityControl, StreetSystem, Listener]:
    """Two refinements of 20 rows that all want to grow, where memory says it has ``free`` bytes."""
    said = iter(free)
    monkeypatch.setattr(density_control, "bytes_for_growth", lambda device: next(said))
    control = every_ten()
    trainer, system, listener = started(control, background=background(20, density=GROWS_ALL))
    for _ in free:
        statistics = control.statistics["background"]
        statistics.gradient_sum += 1 + torch.arange(len(statistics))
        statistics.visits += 1
        trainer.walk(trainer.global_step + 10)
    return control, system, listener


def rows_after(listener: Listener) -> list[int]:
    return [change.after for change, _ in listener.heard if change.reason == "densify"]


def test_memory_holds_growth_back_which_is_said_once(monkeypatch, caplog):
    """20 rows would be 60."""
    with caplog.at_level(logging.WARNING):
        _, system, listener = grown(monkeypatch, 6 * EACH, 0.5 * EACH)
    first, second = rows_after(listener)
    assert 20 < first <= 26
    assert second == first
    assert system.held_back == {"background": 40 - 6 + 2 * first}
    (said,) = [record.message for record in caplog.records if "memory" in record.message]
    assert said.startswith(f"step 10: 'background' would grow by 40 Gaussians of {EACH:,} bytes each, and memory has")
    assert " room for 6: no more are added." in said


def test_where_memory_has_room_nothing_changes(monkeypatch):
    """Not even the draws: rows are those of a run that is not asked."""
    ends = []
    for free in (float("inf"), 40.0 * EACH):
        _, system, _ = grown(monkeypatch, free)
        assert system.held_back == {}
        ends.append(system.scene.nodes["background"].rows)
    assert torch.equal(ends[0].means, ends[1].means)
    assert len(ends[0]) == 60


def test_what_fits_is_what_a_limit_would_allow(monkeypatch):
    """A plan that is made again draws the same numbers."""
    _, system, _ = grown(monkeypatch, 6.0 * EACH)
    strategy = GROWS_ALL
    limited = every_ten()
    monkeypatch.setattr(density_control, "bytes_for_growth", lambda device: float("inf"))
    trainer, other, _ = started(
        limited, background=background(20, density=strategy, max_gaussians=26, limit_rises=False)
    )
    limited.statistics["background"].gradient_sum += 1 + torch.arange(20)
    limited.statistics["background"].visits += 1
    trainer.walk(10)
    assert torch.equal(system.scene.nodes["background"].rows.means, other.scene.nodes["background"].rows.means)


def test_several_processes_add_what_the_fullest_has_room_for(monkeypatch):
    """The largest of the negated rooms, as all of them hear it."""
    heard = []

    class Fuller(Ranks):
        def largest(self, values):
            if values.dim() == 0:
                heard.append(float(values))
                return torch.maximum(values, torch.tensor(-3.0 * EACH, dtype=torch.float64))
            return values

        def sum(self, values):
            return values

    monkeypatch.setattr(density_control, "bytes_for_growth", lambda device: 1e9)
    control = every_ten()
    trainer, system, _ = started(control, background=background(20, density=GROWS_ALL))
    control._ranks = Fuller(0, 2)
    assert control._fits(trainer, system, "background", 40) == 23
    assert heard == [-1e9]
