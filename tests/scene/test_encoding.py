"""Settings as strict JSON, and back."""

import json
import math
import sys
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import pytest
import torch

from sparsestreet.ops import SplatSettings
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.effects import SkySettings
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.loaded_scene import CLASS, decode, decode_as, encode
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.scene.nodes import BackgroundSettings
from tests.scene.street import background_settings


@dataclass(frozen=True)
class Outer:
    @dataclass(frozen=True)
    class Inner:
        value: float

    inner: Inner
    more: dict[str, Inner] = field(default_factory=dict)


def through_json(value: object) -> Any:
    return decode(json.loads(json.dumps(encode(value), allow_nan=False)))


@pytest.mark.parametrize("value", [None, True, 3, "ünïcode", 0.1 + 0.2, 1e-300, -0.0, math.inf, -math.inf, 2**70])
def test_plain_values_come_back_as_they_are(value: Any):
    again = through_json(value)
    assert type(again) is type(value)
    assert again == value
    assert math.copysign(1, again) == math.copysign(1, value) if isinstance(value, float) else True


def test_lists_mappings_and_dataclasses_in_each_other():
    value = Outer(Outer.Inner(math.inf), {"a": Outer.Inner(0.1), "b": Outer.Inner(2.0)})
    assert through_json([{"x": value}, (1, value)]) == [{"x": value}, [1, value]]  # tuples come back as lists
    assert math.isnan(through_json(math.nan))
    assert encode(value)[CLASS] == f"{__name__}:Outer"
    assert encode(value)["inner"] == {CLASS: f"{__name__}:Outer.Inner", "value": {CLASS: "float", "value": "inf"}}


def test_the_settings_of_a_scene():
    settings = background_settings(
        classes=["Car"],
        mask=StaticMaskSettings(0.3, visible_only=True),
        density=GradientDensity(grad_threshold=1 / 3),
        learning_rates={"means": LearningRate(1.6e-4, 1.6e-6, scale_by_scene_radius=True, start=0.1)},
    )
    again = through_json(settings)
    assert isinstance(again, BackgroundSettings)
    assert again == settings
    assert through_json(SplatSettings()) == SplatSettings()
    assert through_json(SkySettings(resolution=3)) == SkySettings(resolution=3)


@pytest.mark.parametrize("value", [torch.zeros(2), {1, 2}, b"bytes", object(), Outer, 1j])
def test_anything_else_is_refused_by_name(value: object):
    with pytest.raises(TypeError, match=f"settings hold plain values.*got a {type(value).__name__}"):
        encode({"deep": [value]})


def test_a_mapping_must_not_look_like_a_dataclass():
    with pytest.raises(ValueError, match="'class' marks a dataclass and is no key of a mapping"):
        encode({"learning_rates": {"class": 1.0}})


def test_what_is_decoded_is_of_the_class_that_is_asked_for():
    encoded = encode(SkySettings(resolution=3))
    assert decode_as(SkySettings, encoded) == SkySettings(resolution=3)
    with pytest.raises(TypeError, match="a SkySettings stands where a LearningRate belongs"):
        decode_as(LearningRate, encoded)


def test_a_class_outside_of_the_package_must_be_imported_first(monkeypatch: pytest.MonkeyPatch):
    """The file never imports foreign code; what the program has imported itself is found."""
    module = ModuleType("my_street")

    @dataclass(frozen=True)
    class Meadow:
        flowers: int

    vars(module)["Meadow"] = Meadow
    Meadow.__module__, Meadow.__qualname__ = "my_street", "Meadow"
    encoded = encode(Meadow(3))
    with pytest.raises(ValueError, match="'my_street:Meadow', which this program has not imported: import my_street"):
        decode(encoded)
    monkeypatch.setitem(sys.modules, "my_street", module)
    assert decode(encoded) == Meadow(3)


def test_a_file_cannot_make_the_program_import(monkeypatch: pytest.MonkeyPatch, tmp_path):
    (tmp_path / "harmful.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("harmful:X", "sparsestreetharmful:X", "sparsestreet:X"):
        with pytest.raises(ValueError, match=r"has not imported|does not have"):
            decode({CLASS: name})
    assert "harmful" not in sys.modules


def test_functions_and_plain_classes_are_no_settings():
    for name in (
        "sparsestreet.scene.loaded_scene:encode",
        "sparsestreet.scene.effects.sky:Sky",
        "sparsestreet.ops:splat",
    ):
        with pytest.raises(ValueError, match="as settings, but that is no dataclass"):
            decode({CLASS: name})


def test_values_that_do_not_fit_the_class():
    with pytest.raises(ValueError, match=r"SkySettings of this version cannot be made from the file.*clouds"):
        decode({CLASS: "sparsestreet.scene.effects.sky:SkySettings", "clouds": 3})
    with pytest.raises(ValueError, match=r"StaticMaskSettings of this version cannot be made.*sparsity_weight"):
        decode({CLASS: "sparsestreet.scene.masks.static:StaticMaskSettings"})
