"""The limit of a test's seconds."""

import pytest

from tests import cpu_limit
from tests.cpu_limit import CpuLimit

pytestmark = pytest.mark.lengthy

TESTS = """
import time
import pytest

def work(seconds):
    started = time.process_time()
    while time.process_time() < started + seconds:
        pass

@pytest.fixture
def made():
    work(0.1)

def test_quick():
    time.sleep(0.1)  # that is nobody's work

def test_working():
    work(0.1)

def test_of_a_fixture(made):
    raise AssertionError("it is not called")

@pytest.mark.lengthy
def test_marked(made):
    work(0.1)
"""


@pytest.fixture
def slowness(monkeypatch) -> dict[str, float]:
    now = {"slowness": 1.0}
    monkeypatch.setattr(cpu_limit, "slowness", lambda: now["slowness"])
    return now


def test_what_takes_longer_without_a_marker_fails_and_says_why(pytester, slowness):
    pytester.makeini("[pytest]\nmarkers = lengthy")
    pytester.makepyfile(TESTS)
    ran = pytester.inline_run("-p", "no:cacheprovider", plugins=[CpuLimit(0.05)])
    passed, _, failed = ran.listoutcomes()
    assert [report.location[2] for report in passed] == ["test_quick", "test_marked"]
    assert [(report.location[2], report.when) for report in failed] == [
        ("test_working", "call"),
        ("test_of_a_fixture", "setup"),
    ]
    assert "its call took 0.1 s of the processor, the limit is 0.05 s" in failed[0].longreprtext
    slowness["slowness"] = 10.0
    passed, _, failed = pytester.inline_run("-p", "no:cacheprovider", plugins=[CpuLimit(0.05)]).listoutcomes()
    assert [report.location[2] for report in failed] == ["test_of_a_fixture"]  # which is called now


def test_the_loop_is_one():
    assert 1 <= cpu_limit.slowness() < 100
