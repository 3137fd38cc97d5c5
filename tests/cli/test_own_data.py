"""`sparsestreet data check` on posed images and on one's own rig, with what conf has for them."""

from dataclasses import fields

import pytest
import yaml
from hydra.utils import get_class

from sparsestreet.cli.commands.data import data
from sparsestreet.cli.config.compose import CONF
from tests.data.colmap.write import write_colmap
from tests.data.nerfstudio.write import write_nerfstudio
from tests.data.plan import Plan
from tests.data.rig_json.write import write_rig

WRITERS = {"colmap": write_colmap, "nerfstudio": write_nerfstudio, "rig_json": write_rig}


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_is_checked(name, tmp_path, capsys):
    WRITERS[name](tmp_path, Plan())
    assert data(["check", f"data={name}", f"data.root={tmp_path}", "split.offset=1"]) == 0
    said = capsys.readouterr().out
    assert "4 x 2" in said
    assert "ready to train" in said
    assert ("sparse points" in said) == (name != "rig_json")


@pytest.mark.parametrize("name", WRITERS)
def test_conf_has_every_option(name):
    log = yaml.safe_load((CONF / "data" / f"{name}.yaml").read_text())["log"]
    assert {entry.name for entry in fields(get_class(log.pop("_target_")))} == log.keys()
