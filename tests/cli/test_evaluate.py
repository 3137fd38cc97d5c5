"""The words of ``sparsestreet evaluate``."""

import pytest

from sparsestreet.cli.evaluate import evaluate


@pytest.mark.parametrize("words", [["novel=-1"], ["novel=1,0"], ["ramp=true"]])
def test_novel_views_need_offsets_above_zero(words, tmp_path, capsys):
    assert evaluate([f"run={tmp_path}", *words]) == 2
    assert "novel" in capsys.readouterr().err


def test_an_unknown_preset_is_named(tmp_path, capsys):
    assert evaluate([f"run={tmp_path}", "presets=fast,quick"]) == 2
    assert "no settings preset 'quick': choose one of" in capsys.readouterr().err
