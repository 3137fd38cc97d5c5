"""A plan says of every effect what was decided, by whom, and what it is predicted to cost."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pytest

from sparsestreet.scene.effects import Cost, Effect, EffectSettings, Finding, plan_effects
from tests.scene.street import training_data

FOUND = Finding(called_for=True, reason="it is seen", value=3.0, unit="px", threshold=1.0, noise=0.1, gain=0.5)


@dataclass(frozen=True, kw_only=True)
class Stub(EffectSettings):
    """An effect that finds what it is told."""

    found: Finding = FOUND

    def detect(self, data) -> Finding:
        assert self.when != "off", "what is off is not looked for"
        return self.found

    def cost(self, data) -> Cost:
        return Cost(numbers=12, ns_per_pixel=2.0, ns_per_row=500.0)

    def build(self, data, finding, generator) -> Effect:
        raise AssertionError("a plan builds nothing")

    def restore(self, tensors: Mapping[str, Any], header: Mapping[str, Any]) -> Effect:
        raise AssertionError("a plan builds nothing")


NOT = replace(FOUND, called_for=False)


@pytest.mark.parametrize(
    ("settings", "on", "source"),
    [
        (Stub(), True, "measured"),
        (Stub(found=NOT), False, "measured"),
        (Stub(found=replace(FOUND, declared=True)), True, "declared"),
        (Stub(found=NOT, when="on"), True, "forced"),
        (Stub(when="off"), False, "forced"),
        # What cannot be simulated is not, however much it is called for.
        (Stub(found=replace(FOUND, missing="give a clock")), False, "measured"),
    ],
)
def test_who_decides_what(settings: Stub, on: bool, source: str):
    data = training_data()
    (decision,) = plan_effects({"stub": settings}, data).decisions(data, rows=1000)
    assert (decision.on, decision.source) == (on, source)


def test_a_decision_has_every_number():
    data = training_data()
    (decision,) = plan_effects({"stub": Stub()}, data).decisions(data, rows=1000)
    pixels = data.views[0].camera.width * data.views[0].camera.height
    assert (decision.value, decision.threshold, decision.noise, decision.unit) == (3.0, 1.0, 0.1, "px")
    assert (decision.numbers, decision.gain, decision.reason) == (12, 0.5, "it is seen")
    assert decision.ms == pytest.approx((2.0 * pixels + 500.0 * 1000) * 1e-6)


def test_forcing_what_the_data_cannot_support_says_what_is_missing():
    missing = replace(NOT, reason="no image has a stamp", missing="give a clock")
    with pytest.raises(ValueError, match=r"^effects\.stub is on, but no image has a stamp: give a clock, or say auto$"):
        plan_effects({"stub": Stub(found=missing, when="on")}, training_data())


@dataclass(frozen=True, kw_only=True)
class OffByDefault(Stub):
    found_when_off: ClassVar[bool] = True

    def detect(self, data) -> Finding:
        return self.found


def test_what_is_off_by_default_says_what_the_log_shows_and_stays_off():
    data, settings = training_data(), OffByDefault(when="off")
    (decision,) = plan_effects({"stub": settings}, data).decisions(data, rows=1000)
    assert (decision.on, decision.value, decision.threshold) == (False, 3.0, 1.0)
    assert decision.reason == "found, not simulated (effects.stub=auto simulates it): it is seen"
    (decision,) = plan_effects({"stub": replace(settings, found=NOT)}, data).decisions(data, rows=1000)
    assert (decision.on, decision.reason) == (False, "it is seen")
