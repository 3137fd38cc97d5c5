"""A pytest plugin: test files that import a package which is not installed are left out, and named at the end.

Without it one such file ends the whole run before any test. Other errors of import stay errors, those of the project's
own modules among them. ``pytest -p leave_out_missing`` with this folder on PYTHONPATH.
"""

from collections.abc import Generator

import pytest

_OWN = ("sparsestreet", "tests")
_SIGN = "left out: no "


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    if report.failed and isinstance(collector, pytest.Module):
        cause = report.call.excinfo.value.__cause__
        package = (cause.name or "").split(".")[0] if isinstance(cause, ModuleNotFoundError) else ""
        if package and package not in _OWN:
            report.outcome, report.longrepr = "skipped", (report.nodeid, 0, f"{_SIGN}{package}")
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    skipped = (report.longrepr for report in terminalreporter.stats.get("skipped", []))
    reasons = {(place[0], place[2]) for place in skipped if isinstance(place, tuple) and place[2].startswith(_SIGN)}
    for file, reason in sorted(reasons):
        terminalreporter.write_line(f"left out: {file} ({reason.removeprefix('left out: ')})")
