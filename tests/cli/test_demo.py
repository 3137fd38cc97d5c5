"""The three trainings of a demonstration, and what is made of them."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sparsestreet.cli import demo as module
from sparsestreet.cli.demo import demo
from sparsestreet.records.summary import SUMMARY
from sparsestreet.scene.centers import node_legend
from tests.evaluation.frames import make_summary


@pytest.fixture
def asked(tmp_path, monkeypatch) -> list[Any]:
    """Commands, comparisons and reports, none of which is made."""
    monkeypatch.chdir(tmp_path)
    calls: list[Any] = []

    def trained(command, check):
        calls.append(command)
        (out,) = (word.partition("=")[2] for word in command if word.startswith("out="))
        SUMMARY.write(Path(out), make_summary(Path(out).name, gaussians={"background": 7, "rigid": 2}))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(subprocess, "run", trained)
    monkeypatch.setattr(module, "compare_runs", lambda *given, **named: calls.append((given, named)))
    monkeypatch.setattr(module, "report", lambda words: calls.append(words) or 3)
    return calls


def test_three_runs_one_table_and_pictures(asked, capsys):
    assert demo(["seed=1", "schedule.max_steps=20"]) == 3
    *commands, (given, named), words = asked
    out, start = Path("outputs/demo"), [sys.executable, "-m", "sparsestreet", "train"]
    names = ("none", "paper_short", "removal")
    assert commands == [
        [*start, f"sparsify={name}", "assignment=all_rigid", "schedule.max_steps=1200", f"out={out / name}",
         "seed=1", "schedule.max_steps=20"]
        for name in names
    ]  # fmt: skip
    runs = [out / name for name in names]
    assert (given, named) == ((runs, out / "comparison.png"), {"legend": node_legend({"background": 7, "rigid": 2})})
    assert words == [*map(str, runs), "baseline=none", "markdown=outputs/demo/table.md"]
    said = capsys.readouterr().out
    assert "pictures: outputs/demo/comparison.png, outputs/demo/removal/pictures/sheet.png (0 s in all)" in said
    assert "sparsestreet render scene=outputs/demo/removal path=shifted offset=1.5 out=drive.mp4" in said
    assert [f"== sparsify={name} ==" in said for name in names] == [True] * 3


def test_the_first_failure_ends_it(asked, monkeypatch):
    statuses = iter((0, 130))
    monkeypatch.setattr(subprocess, "run", lambda *given, **how: SimpleNamespace(returncode=next(statuses)))
    assert demo([]) == 130
    assert asked == []


def test_help(asked, capsys):
    assert demo(["--help"]) == 0
    assert "sparsestreet demo [key=value ...]" in capsys.readouterr().out
