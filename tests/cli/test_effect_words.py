"""Short words for effects become the keys that the configuration has."""

import pytest

from sparsestreet.cli.config.compose import composed
from sparsestreet.cli.config.validate import with_effect_keys


@pytest.mark.parametrize(
    ("typed", "written"),
    [
        ("effects.lens=on", "effects.lens.when=on"),
        ("effects.sky=off,auto", "effects.sky.when=off,auto"),
        # What has another meaning stays.
        ("effects.sky.resolution=8", "effects.sky.resolution=8"),
        ("effects=[sky]", "effects=[sky]"),
        ("moved_views=none", "moved_views=none"),
        ("-m", "-m"),
    ],
)
def test_one_effect(typed: str, written: str):
    assert with_effect_keys(["seed=1", typed]) == ["seed=1", written]


def test_all_effects_at_once():
    names = list(composed(())["effects"])
    assert with_effect_keys(["effects=off"]) == [f"effects.{name}.when=off" for name in names]
    off = composed(tuple(with_effect_keys(["effects=off"])))
    assert {one.when for one in off.effects.values()} == {"off"}
