"""Configurations composed in less time are those that Hydra composes: tests/cli/composing.py."""

import os
from collections.abc import Iterator
from typing import Any

import pytest
from hydra import compose
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig

from sparsestreet.cli.config.compose import configuration
from tests.cli import composing


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    yield
    composing.speed_up()


def composed(*overrides: str) -> DictConfig:
    with configuration():
        return compose("train", [*overrides, "folder=."], return_hydra_config=True)


def nodes(tree: Any, name: str = "") -> Iterator[tuple]:
    """All that a configuration holds, before interpolations are resolved, with types, flags and order of keys."""
    metadata = {key: value for key, value in vars(tree._metadata).items() if key != "resolver_cache"}
    inner = tree._content if isinstance(tree, DictConfig | ListConfig) else None
    yield name, type(tree), metadata, tree._value() if inner is None else None
    pairs = inner.items() if isinstance(inner, dict) else enumerate(inner) if isinstance(inner, list) else ()
    for key, value in pairs:
        assert value._get_parent() is tree
        yield from nodes(value, f"{name}.{key}")


@pytest.mark.lengthy
@pytest.mark.parametrize(
    ("first", "second"),
    [
        (["seed=1"], ["seed=2", "node.background.max_gaussians=7"]),
        # Defaults that follow another choice: preset/method.
        (["method=omnire", "preset=drivestudio"], ["preset=drivestudio", "+node.rigid.new=1", "method=omnire"]),
        (["+sweep=tiny", "~image_points"], ["+sweep=tiny", "~image_points", "~evaluation.timing", "+data={new: 1}"]),
    ],
    ids=["values", "options", "added and taken away"],
)
def test_it_is_hydras(first, second):
    """What is joined for the first serves the second, which has other values."""
    composing.as_shipped()
    by_hydra = [list(nodes(composed(*overrides))) for overrides in (first, second)]
    composing.speed_up()
    assert [list(nodes(composed(*overrides))) for overrides in (first, second, first)] == [*by_hydra, by_hydra[0]]


def test_an_unknown_option_is_hydras_error_each_time():
    for _ in range(2):
        with pytest.raises(HydraException, match="Could not find 'method/no'"):
            composed("method=no")


def test_a_file_that_was_written_again_is_read_again(tmp_path):
    (tmp_path / "data").mkdir()
    file = tmp_path / "data" / "own.yaml"
    for number in (1, 2):
        file.write_text(f"value: {number}\n")
        os.utime(file, ns=(number, number))
        assert composed("data=own", f"hydra.searchpath=[{tmp_path}]").data.value == number
