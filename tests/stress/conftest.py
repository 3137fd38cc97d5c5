"""What breaks runs: kills, damaged and hostile files, long runs, neighbors. ``make stress`` runs all of it."""

import os
from collections.abc import Iterator

import pytest

from tests.cli.conftest import tiny_street
from tests.conftest import unchecked

__all__ = ["tiny_street"]

if not hasattr(os, "fork"):
    collect_ignore_glob = ["test_*.py"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What only ``make stress`` runs is slow, whoever asks."""
    for item in items:
        if item.get_closest_marker("stress"):
            item.add_marker("slow")


@pytest.fixture(autouse=True, scope="package")
def quick() -> Iterator[None]:
    with unchecked():
        yield
