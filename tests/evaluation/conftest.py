"""Renders that are a tenth darker than the images."""

import pytest

from tests.evaluation.dark import darker
from tests.evaluation.scenes import replace_render


@pytest.fixture
def dark(monkeypatch):
    replace_render(monkeypatch, darker)
