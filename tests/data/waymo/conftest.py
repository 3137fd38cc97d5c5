"""The drive in both versions, written once for all tests of this folder."""

import os
from pathlib import Path

import pytest

from tests.data.waymo import records, tables
from tests.data.waymo.drive import Drive


@pytest.fixture(scope="session")
def drive() -> Drive:
    return Drive()


@pytest.fixture(scope="session")
def roots(tmp_path_factory, drive) -> dict[int, Path]:
    """Folder of each version; not to be changed."""
    root = tmp_path_factory.mktemp("waymo")
    records.write_drive(root / "v1", drive)
    found = {1: root / "v1"}
    try:
        tables.write_drive(root / "v2", drive)
        found[2] = root / "v2"
    except ImportError:
        pass
    return found


@pytest.fixture(params=[1, 2])
def root(request, roots) -> Path:
    """The drive in either version."""
    if request.param not in roots:
        pytest.skip("version 2 needs pyarrow: pip install 'sparsestreet[parquet]'")
    return roots[request.param]


@pytest.fixture(scope="session")
def genuine() -> Path:
    """The folder of genuine samples; skips where it is absent."""
    default = Path(__file__).resolve().parents[4] / "shared" / "data"
    root = Path(os.environ.get("SPARSESTREET_DATA", default))
    if not (root / "waymo_one_frame").is_dir():
        pytest.skip(f"no Waymo samples at {root}: set SPARSESTREET_DATA to the folder that holds waymo_one_frame")
    return root
