"""Triton's interpreter in reasonable time: what it needs not do left out, costly cases left to ``make test-all``."""

import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch

from sparsestreet.ops.backend import has_triton
from tests.conftest import unchecked
from tests.ops.scenes import fill_buffers_with_nan

INTERPRETED = has_triton() and not torch.cuda.is_available()
if INTERPRETED:
    from tests.ops.interpreter import check_overflow, speed_up

    speed_up()

    @pytest.fixture(autouse=True)
    def _overflow(request: pytest.FixtureRequest) -> None:
        """Integers are watched in the tests that only ``make test-all`` runs."""
        check_overflow(request.node.get_closest_marker("slow") is not None)


@pytest.fixture(autouse=True)
def _unknown_views() -> None:
    """A rendering takes the same path whatever was rendered before, in other tests."""
    capacity = sys.modules.get("sparsestreet.ops.triton.lists")
    if capacity is not None:
        capacity._seen.clear()


@pytest.fixture
def poisoned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing may be read before it is written."""
    fill_buffers_with_nan(monkeypatch)


ON_NUMBERS = ("test_hard_", "test_effects_", "test_guards_drawn", "test_properties")
"""Many small scenes through the whole op, whose shapes the tests of each backend check."""


@pytest.fixture(autouse=True, scope="module")
def _checks(request: pytest.FixtureRequest) -> Iterator[None]:
    with unchecked() if request.path.stem.startswith(ON_NUMBERS) else nullcontext():
        yield


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    kernels = Path(__file__).parent / "triton"
    for item in items:
        if INTERPRETED and item.path.parent == kernels:
            item.add_marker("interpreted")
        if item.get_closest_marker("interpreted") and item.get_closest_marker("slow_if_interpreted"):
            item.add_marker("slow")
