"""A test that takes seconds says so: one without a marker for it fails above two seconds of the processor.

Seconds of the processor, of the test's processes together, do not depend on who else computes; how fast the processor
is, a fixed loop tells, which runs where a test is above the limit.
"""

import math
import os
import statistics
import time
from collections.abc import Generator
from typing import Any

import pytest

LIMIT = 2.0
"""Seconds, on a machine as fast as the one of ``LOOP_SECONDS``."""
LOOP_SECONDS = 0.0095
"""Of the loop, on a quiet machine on which ``make test`` takes about three minutes."""
MARKERS = ("lengthy", "slow")
_TAKEN = pytest.StashKey[float]()


class CpuLimit:
    """A plugin; what a test's fixtures take when it is the first to ask for them is its own."""

    def __init__(self, limit: float = LIMIT) -> None:
        self._limit = limit

    def _timed(self, item: pytest.Item) -> Generator[None, Any, Any]:
        started = processor_seconds()
        try:
            return (yield)
        finally:
            item.stash[_TAKEN] = processor_seconds() - started

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Generator[None, Any, Any]:
        return (yield from self._timed(item))

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, Any, Any]:
        return (yield from self._timed(item))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        taken = item.stash.get(_TAKEN, 0.0)
        if call.when == "teardown" or not report.passed or taken <= self._limit:
            return report
        if not any(item.get_closest_marker(name) for name in MARKERS) and taken > self._limit * slowness():
            report.outcome = "failed"
            report.longrepr = (
                f"{item.nodeid}: its {call.when} took {taken:.1f} s of the processor, the limit is {self._limit:g} s: "
                "make it smaller or share what it makes; where it is worth its seconds every day, mark it lengthy"
            )
        return report


def processor_seconds() -> float:
    """Of this process and of the children that it has waited for."""
    return sum(os.times()[:4])


def slowness() -> float:
    """How many times longer than on the machine of ``LOOP_SECONDS`` a loop takes now; 1 where it takes less.

    No limit holds where torch is told to use other instructions than it would (``make elsewhere``): the loop has none.
    """
    if "ATEN_CPU_CAPABILITY" in os.environ:
        return math.inf
    return max(1.0, statistics.median(_loop() for _ in range(9)) / LOOP_SECONDS)


def _loop() -> float:
    started = time.process_time()
    len({str(number): (number,) for number in range(50_000)})  # in and out of caches, as tests are
    return time.process_time() - started
