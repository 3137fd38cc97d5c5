"""``sparsestreet effects`` prints a plan without training."""

import pytest

from sparsestreet.cli.commands.effects import effects


def test_the_plan_of_a_street(tiny_street, tmp_path, capsys):
    assert effects([*tiny_street, "effects.affine=on", f"out={tmp_path}"]) == 0
    said = capsys.readouterr().out
    assert "of 2 cameras" in said
    assert "lens          off  declared  0 px (on from 0.5)" in said
    assert "affine        on   forced" in said
    assert "planned in" in said
    assert f"drawn: {tmp_path / 'evidence.png'}" in said
    assert (tmp_path / "evidence.png").is_file()


def test_what_cannot_be_forced_is_one_line(tiny_street, capsys):
    assert effects([*tiny_street, "effects.lens=on"]) == 1
    assert capsys.readouterr().err.startswith("sparsestreet effects: effects.lens is on, but 0 of 2 cameras")


@pytest.mark.parametrize("wrong", ["effects.lens=maybe", "lenz=1", "data=auto"])
def test_wrong_words(wrong: str, capsys):
    assert effects([wrong]) == 2
    assert capsys.readouterr().err.startswith("sparsestreet effects: ")


def test_help(capsys):
    assert effects(["--help"]) == 0
    assert "trains nothing" in capsys.readouterr().out
