"""Recorded data in nuScenes' layout, where it is."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parents[4] / "shared" / "data"


@pytest.fixture(scope="session")
def recorded() -> Callable[[str], Path]:
    """A folder of recorded data; skips where it is absent."""

    def folder(name: str) -> Path:
        root = Path(os.environ.get("SPARSESTREET_DATA", _DEFAULT)) / name
        if not root.is_dir():
            pytest.skip(f"no recorded data at {root}: set SPARSESTREET_DATA to the folder that holds {name}")
        return root

    return folder
