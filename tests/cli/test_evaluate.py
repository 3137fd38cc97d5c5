"""The words of ``sparsestreet evaluate``."""

from pathlib import Path

import pytest

from sparsestreet.cli.commands.evaluate import Options, evaluate, extra_words
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.evaluation.speed import Timing


@pytest.mark.parametrize("words", [["novel=-1"], ["novel=1,0"], ["ramp=true"]])
def test_novel_views_need_offsets_above_zero(words, tmp_path, capsys):
    assert evaluate([f"run={tmp_path}", *words]) == 2
    assert "novel" in capsys.readouterr().err


def test_an_unknown_preset_is_named(tmp_path, capsys):
    assert evaluate([f"run={tmp_path}", "presets=fast,quick"]) == 2
    assert "no settings preset 'quick': choose one of" in capsys.readouterr().err


def test_an_evaluation_measures_what_the_runs_configuration_asks_for_unless_it_is_told_otherwise():
    of_run = ExtraMetrics(novel=[1.5], presets=["fast"])
    assert Options(Path("run")).extra(of_run) == of_run
    told = Options(Path("run"), novel=(2.0,), ramp=True, presets=()).extra(of_run)
    assert told == ExtraMetrics(novel=(2.0,), ramp=True, presets=())
    assert of_run.timing == Timing(20, 50, 25)
    assert extra_words(of_run) == ["novel=1.5", "presets=fast"]
    assert extra_words(told) == ["novel=2", "ramp=true"]
