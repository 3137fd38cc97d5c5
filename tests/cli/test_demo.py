"""The three trainings of a demonstration, and what is made of them."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from sparsestreet.cli.commands import demo as module
from sparsestreet.cli.commands.demo import demo
from sparsestreet.pictures.images import KINDS, picture_path, write_png
from sparsestreet.records.summary import HELD_OUT, QUALITY, SUMMARY
from sparsestreet.scene.rendering import node_legend
from tests.evaluation.frames import disturbed, make_image, make_summary

TITLES = ["plain", "the paper's method (short)", "ours"]


@pytest.fixture
def asked(tmp_path, monkeypatch) -> list[Any]:
    """Commands and comparisons, none of which is made: each training leaves a record (21, 22, 23 dB) and a picture."""
    monkeypatch.chdir(tmp_path)
    calls: list[Any] = []

    def trained(command, check):
        calls.append(command)
        (place,) = (one for one in OverridesParser.create().parse_overrides(command[4:]) if one.key_or_group == "out")
        run, label = Path(str(place.value())), f"plain+{len(calls)}" if len(calls) > 1 else "plain"
        summary = make_summary(label, 0, 20.0 + len(calls), {"background": 7, "rigid": 2})
        SUMMARY.write(run, disturbed(summary, "training") if len(calls) == 1 else summary)
        QUALITY[HELD_OUT].write(run, [make_image(5)])
        for kind in KINDS:
            write_png(picture_path(run / "pictures", 5, 0, kind), np.zeros((30, 48, 3), dtype=np.uint8))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(subprocess, "run", trained)
    monkeypatch.setattr(module, "compare_runs", lambda *given, **named: calls.append((given, named)))
    return calls


def test_three_runs_one_table_and_pictures(asked, monkeypatch, capsys):
    monkeypatch.setattr(module, "report", lambda words: asked.append(words) or 3)
    assert demo(["seed=1", "schedule.max_steps=20"]) == 3
    *commands, (given, named), words = asked
    out, start = Path("outputs/demo"), [sys.executable, "-m", "sparsestreet", "train"]
    names = ("none", "paper_short", "removal")
    assert commands == [
        [*start, f"sparsify={name}", "assignment=all_rigid", "schedule.max_steps=800", "overwrite=true",
         "data.log.settings.width=240", "data.log.settings.height=144", "data.log.settings.num_frames=30",
         "data.log.settings.num_cameras=2", "capacity.background.max_gaussians=70000",
         f"out={out / name}", "seed=1", "schedule.max_steps=20"]
        for name in names
    ]  # fmt: skip
    runs = [out / name for name in names]
    assert (given, named) == (
        (runs, out / "comparison.png"),
        {"legend": node_legend({"background": 7, "rigid": 2}), "titles": TITLES},
    )
    assert words == ["sweep=outputs/demo"]
    said = capsys.readouterr().out
    assert "pictures: outputs/demo/comparison.png, outputs/demo/removal/pictures/sheet.png\n" in said
    assert "in a browser: outputs/demo/report/index.html (" in said
    assert "sparsestreet render scene=outputs/demo/removal path=shifted offset=1.5 out=drive.mp4" in said
    assert [f"== sparsify={name} ==" in said for name in names] == [True] * 3


def test_another_log_has_its_own_size(asked, monkeypatch):
    monkeypatch.setattr(module, "report", lambda words: 0)
    assert demo(["data=auto", "data.root=x"]) == 0
    assert not set(module.SMALL) & {word for command in asked[:3] for word in command}
    asked.clear()
    assert demo(["data=synthetic"]) == 0
    assert all(set(module.SMALL) <= set(command) for command in asked[:3])


@pytest.mark.lengthy
def test_the_one_comparison_is_the_last_table(asked, tmp_path, capsys):
    """Headed by words, with the mark of times that were disturbed; the long tables come before it."""
    (tmp_path / "d").mkdir()  # the sheet would be there
    assert demo([f"out={tmp_path / 'd'}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    heads = [number for number, line in enumerate(lines) if "┃" in line]
    last = [
        [cell.strip() for cell in line.replace("┃", "│").split("│")[1:-1]]
        for line in lines[heads[-1] :]
        if "│" in line or "┃" in line
    ]
    assert last[0] == ["", *TITLES]
    assert last[1] == ["held-out PSNR, dB", "21.00", "22.00", "23.00"]
    assert last[-1] == ["seconds of training", "100 §", "100", "100"]
    assert any("not quiet" in line for line in lines[heads[-1] :])
    assert len(lines) - heads[-1] < 14


@pytest.mark.parametrize("word", ["sparsify=paper", "folder=x", "hydra.run.dir=x", "resume=x", "-m", "out="])
def test_what_would_make_one_run_of_three_is_refused(word, asked, capsys):
    assert demo([word]) == 2
    assert not asked
    assert capsys.readouterr().err.count("\n") == 1
