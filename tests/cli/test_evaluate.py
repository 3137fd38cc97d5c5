"""The words of ``sparsestreet evaluate``."""

from pathlib import Path

import pytest

from sparsestreet.cli.evaluate import Options, evaluate
from sparsestreet.evaluation.extra import ExtraMetrics


@pytest.mark.parametrize("words", [["novel=-1"], ["novel=1,0"], ["ramp=true"]])
def test_novel_views_need_offsets_above_zero(words, tmp_path, capsys):
    assert evaluate([f"run={tmp_path}", *words]) == 2
    assert "novel" in capsys.readouterr().err


def test_an_unknown_preset_is_named(tmp_path, capsys):
    assert evaluate([f"run={tmp_path}", "presets=fast,quick"]) == 2
    assert "no settings preset 'quick': choose one of" in capsys.readouterr().err


def test_an_evaluation_measures_what_the_runs_configuration_asks_for_unless_it_is_told_otherwise():
    of_run = ExtraMetrics(novel=[1.5], presets=["fast"])
    assert Options(Path("run")).looks(of_run) == of_run
    told = Options(Path("run"), novel=(2.0,), ramp=True, presets=()).looks(of_run)
    assert told == ExtraMetrics(novel=(2.0,), ramp=True, presets=())
    assert of_run.words() == ["novel=1.5", "presets=fast"]
    assert told.words() == ["novel=2", "ramp=true"]
