"""The command reads nuScenes' tables by its options."""

import pytest
from omegaconf import OmegaConf

from sparsestreet.cli.commands.data import data
from tests.cli.configurations import composed
from tests.data.nuscenes.written import write_nuscenes
from tests.data.plan import Plan


def test_a_scene_is_checked(tmp_path, capsys):
    root = write_nuscenes(tmp_path / "drive", Plan(num_frames=3)).root
    assert (
        data(
            [
                "check",
                "data=nuscenes",
                f"data.root={root}",
                "data.log.scene=scene-0061",
                "data.log.rate=all",
                "split.stride=0",
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert "3 x 2" in printed
    assert "scene-0061 is read, at place 0 of v1.0-mini/scene.json" in printed


@pytest.mark.parametrize(("scene", "said"), [("61", "data.log.scene=scene-0061"), ("scene-0103", "no scene of")])
def test_a_number_is_a_place(scene, said, tmp_path, capsys):
    root = write_nuscenes(tmp_path / "drive", Plan(num_frames=2)).root
    assert data(["check", "data=nuscenes", f"data.root={root}", f"data.log.scene={scene}"]) == 2
    assert said in capsys.readouterr().err


def test_classes_are_those_of_drivestudios_layout():
    """So that nodes take the same objects of a scene, whichever way it is read."""
    ours, theirs = (
        OmegaConf.to_container(composed(f"data={name}", "data.root=x").data.classes)
        for name in ("nuscenes", "drivestudio")
    )
    assert isinstance(ours, dict)
    assert isinstance(theirs, dict)
    for kind, names in theirs.items():
        assert set(ours[kind]) == {name for name in names if "." in name or name == "animal"}
