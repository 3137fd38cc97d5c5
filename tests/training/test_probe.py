"""Two short trainings that decide about an effect: on a wall whose images have gains, or have none."""

from dataclasses import replace
from typing import Literal

import pytest
import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.kept import Kept
from sparsestreet.scene.effects import ExposureSettings, Finding, ProbedGain
from sparsestreet.scene.nodes import BackgroundSettings
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.training import probe as probe_module
from sparsestreet.training.losses import Photometric
from sparsestreet.training.probe import Probe
from sparsestreet.training.recipe import Recipe
from tests.evidence import wall
from tests.scene.effects.test_exposure import log_of

NODES = {"background": BackgroundSettings(mask=None, masked=False, density=None, prunable=False)}


def wave(size: float) -> torch.Tensor:
    """Log gains of two cameras that swing against each other, slowly enough for neighbors to foretell them."""
    phases = torch.arange(wall.INSTANTS) * 2 * torch.pi / 10
    return size * torch.stack((phases.sin(), -phases.sin()), 1)[..., None].expand(-1, -1, 3)


def recipe(when: Literal["auto", "on", "off"] = "auto") -> Recipe:
    effects = {"exposure": ExposureSettings(when=when, threshold=0.1)}
    return Recipe(NODES, effects, losses={"photometric": Photometric()}, seed=3)


def probe_of(data: StreetData) -> Probe:
    parts = recipe()
    log, optimizer = data.driving_log, parts.optimizer
    options = RenderOptions(backend="triton")  # of a run on a GPU
    return Probe(log, data.split.train, frozenset(), NODES, parts.losses, optimizer, options, parts.seed)


@pytest.mark.lengthy
def test_gains_that_images_have_are_worth_their_effect_and_others_are_not(monkeypatch):
    monkeypatch.setattr(probe_module, "STEPS", 40)
    monkeypatch.setattr(probe_module, "EVERY", 4)
    found = {}
    for size in (0.15, 0.0):
        data = StreetData(log_of(wave(size)), stride=0)
        found[size] = probe_of(data).gain(recipe(when="off").plan(data), "exposure")
    planted, none = found.values()
    assert planted is not None
    assert none is not None
    assert planted.is_certain
    assert planted.mean > 1
    assert planted.images == none.images == 2 * 3  # of both cameras at instants 2, 6 and 10
    assert abs(none.mean) < 0.2


def test_what_a_probe_measures_on_fewer_images_is_not_kept_for_the_run(monkeypatch, tmp_path):
    monkeypatch.setattr(probe_module, "STEPS", 1)
    monkeypatch.setattr(probe_module, "EVERY", 4)
    data = StreetData(replace(log_of(wave(0.1)), kept=Kept(tmp_path, "wall")), stride=0)
    plan, kept = recipe(when="off").plan(data), data.driving_log.kept
    first = probe_of(data).kept_gain(plan, "exposure")
    assert set(kept.made) == {"bounds", "probe-exposure"}  # the first of the whole log
    monkeypatch.setattr(Probe, "gain", lambda *args: pytest.fail("it is kept"))
    assert probe_of(data).kept_gain(plan, "exposure") == first


@pytest.mark.parametrize(
    ("gain", "on", "source", "said"),
    [
        (ProbedGain(0.3, 0.1, 6), True, "probed", "+0.30 ± 0.10 dB in 6 images with the effect"),
        (ProbedGain(0.1, 0.2, 6), False, "probed", "+0.10 ± 0.20 dB"),
        (ProbedGain(-1.0, 0.1, 6), False, "probed", "-1.00 ± 0.10 dB"),
        (None, True, "measured", "seen"),  # too short a drive for a probe
    ],
)
def test_near_its_threshold_a_probe_decides(monkeypatch, gain, on, source, said):
    asked = []
    monkeypatch.setattr(Probe, "gain", lambda self, plan, name: asked.append(name) or gain)
    near = Finding(called_for=True, reason="seen", value=0.12, unit="EV", threshold=0.1, noise=0.01)
    monkeypatch.setattr(ExposureSettings, "detect", lambda self, data: near)
    data = StreetData(log_of(wave(0.0)), stride=0)
    (decision,) = recipe().decisions(recipe().plan(data), data)
    assert asked == ["exposure"]
    assert (decision.on, decision.source) == (on, source)
    assert said in decision.reason
    recipe(when="on").plan(data)
    recipe(when="off").plan(data)
    assert asked == ["exposure"]


@pytest.mark.parametrize(
    ("value", "noise", "near"),
    [(0.12, 0.0, True), (0.19, 0.0, True), (0.2, 0.0, False), (0.09, 0.006, True), (0.09, 0.004, False),
     (None, 0.1, False), (0.12, None, False)],
)  # fmt: skip
def test_what_is_near(value, noise, near):
    found = Finding(called_for=False, reason="", value=value, threshold=0.1, noise=noise)
    assert found.is_near() is near
    assert not replace(found, missing="a clock").is_near()
