"""Triton's interpreter in reasonable time: what it needs not do left out, costly cases left to ``make test-all``."""

from pathlib import Path

import pytest
import torch

from sparsestreet.ops.backend import has_triton

INTERPRETED = has_triton() and not torch.cuda.is_available()
if INTERPRETED:
    from tests.ops.interpreter import check_overflow, speed_up

    speed_up()

    @pytest.fixture(autouse=True)
    def _overflow(request: pytest.FixtureRequest) -> None:
        """Integers are watched in the tests that only ``make test-all`` runs."""
        check_overflow(request.node.get_closest_marker("slow") is not None)


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    kernels = Path(__file__).parent / "triton"
    for item in items:
        if INTERPRETED and item.path.parent == kernels:
            item.add_marker("interpreted")
        if item.get_closest_marker("interpreted") and item.get_closest_marker("slow_if_interpreted"):
            item.add_marker("slow")
