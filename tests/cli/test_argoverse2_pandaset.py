"""The command reads logs of Argoverse 2 and PandaSet by their names."""

import pytest

from sparsestreet.cli.commands.data import data
from tests.data.argoverse2.write import write_log
from tests.data.pandaset.write import PandaPlan, write_sequence
from tests.data.plan import Plan


def test_a_log_of_argoverse_2_is_checked(tmp_path, capsys):
    pytest.importorskip("pyarrow", reason="feather files need pyarrow")
    write_log(tmp_path, Plan(num_frames=2))
    assert data(["check", "data=argoverse2", f"data.root={tmp_path}", "data.log.scene=7f00", "split.stride=0"]) == 0
    assert "2 x 2" in capsys.readouterr().out
    assert data(["check", "data=argoverse2", f"data.root={tmp_path}", "data.log.scene=7e128381"]) == 2
    assert "put the name of the log into quotes" in capsys.readouterr().err


def test_a_sequence_of_pandaset_is_checked(tmp_path, capsys):
    write_sequence(tmp_path, PandaPlan(num_frames=2))
    command = [
        "check",
        "data=pandaset",
        f"data.root={tmp_path}",
        "data.log.cameras=[front_camera,left_camera]",
        "split.stride=0",
    ]
    assert data([*command, "data.log.scene=001"]) == 0
    assert "2 x 2" in capsys.readouterr().out
    assert data([*command, "data.log.scene=011"]) == 2
    assert "say data.log.scene=, one of 001" in capsys.readouterr().err
