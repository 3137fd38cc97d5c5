"""The common drive as rig.json."""

from pathlib import Path

import pytest

from tests.data.plan import Plan
from tests.data.rig_json.write import write_rig
from tests.shared import made_once

PLAN = Plan()


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return made_once(tmp_path_factory, "rig_json", lambda folder: write_rig(folder, PLAN))


@pytest.fixture
def written(tmp_path):
    """A folder and its JSON's content, to be changed."""
    return tmp_path, write_rig(tmp_path, PLAN)
