"""Whole streets are traced without checks of shapes; the tracer's parts have tests of their own, with checks."""

from collections.abc import Iterator
from contextlib import nullcontext

import pytest

from tests.conftest import unchecked

OF_WHOLE_STREETS = ("test_reader", "test_street")


@pytest.fixture(autouse=True, scope="module")
def _checks(request: pytest.FixtureRequest) -> Iterator[None]:
    with unchecked() if request.path.stem in OF_WHOLE_STREETS else nullcontext():
        yield
