"""``sparsestreet data check`` on what each reader reads, by the options that conf has for it."""

from collections.abc import Callable
from dataclasses import MISSING, fields
from pathlib import Path

import pytest
import yaml
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf

from sparsestreet.cli.commands.data import data
from sparsestreet.cli.config.compose import CONF
from sparsestreet.data.synthetic import LidarSensor, StreetSettings
from tests.cli.configurations import composed
from tests.data.argoverse2.write import write_log
from tests.data.colmap.write import write_colmap
from tests.data.nerfstudio.write import write_nerfstudio
from tests.data.nuscenes.written import write_nuscenes
from tests.data.pandaset.write import PandaPlan, write_sequence
from tests.data.plan import Plan
from tests.data.rig_json.write import write_rig
from tests.data.waymo import records
from tests.data.waymo.drive import Drive

NAME = "10023947602400723454_1120_000_1140_000"


def write_waymo(root: Path) -> None:
    for name in (NAME, "2"):
        records.write_drive(root, Drive(num_frames=3), name)
    (root / "list.txt").write_text(f"2\n{NAME}\n")


WRITERS: dict[str, Callable[[Path], object]] = {
    "colmap": lambda root: write_colmap(root, Plan()),
    "nerfstudio": lambda root: write_nerfstudio(root, Plan()),
    "rig_json": lambda root: write_rig(root, Plan()),
    "nuscenes": lambda root: write_nuscenes(root, Plan(num_frames=3)),
    "argoverse2": lambda root: write_log(root, Plan(num_frames=2)),
    "pandaset": lambda root: write_sequence(root, PandaPlan(num_frames=2)),
    "waymo": write_waymo,
}


@pytest.mark.parametrize(
    ("name", "words", "status", "said"),
    [
        ("colmap", "split.offset=1", 0, "4 x 2|ready to train|sparse points"),
        ("nerfstudio", "split.offset=1", 0, "4 x 2|ready to train|sparse points"),
        ("rig_json", "split.offset=1", 0, "4 x 2|ready to train"),
        ("nuscenes", "data.log.scene=scene-0061 data.log.rate=all", 0, "3 x 2|scene-0061 is read, at place 0 of v1.0"),
        ("nuscenes", "data.log.scene=61", 2, "data.log.scene=scene-0061"),
        ("nuscenes", "data.log.scene=scene-0103", 2, "no scene of"),
        ("argoverse2", "data.log.scene=7f00", 0, "2 x 2"),
        ("argoverse2", "data.log.scene=7e128381", 2, "put the name of the log into quotes"),
        ("pandaset", "data.log.cameras=[front_camera,left_camera] data.log.scene=001", 0, "2 x 2"),
        ("pandaset", "data.log.scene=011", 2, "say data.log.scene=, one of 001"),
        ("waymo", f"data.log.scene={NAME}", 0, f"3 x 2|{NAME}"),
        ("waymo", f"data.log.scene='{NAME}'", 0, NAME),
        ("waymo", "data.log.scene=1 data.log.scenes=ROOT/list.txt", 0, NAME),
        ("waymo", "", 2, "data.log.scene must name one of the segments"),
    ],
)
def test_a_log_is_checked_by_its_options(name, words, status, said, tmp_path, capsys):
    if name == "argoverse2":
        pytest.importorskip("pyarrow", reason="feather files need pyarrow")
    WRITERS[name](tmp_path)
    split = [] if "split." in words else ["split.stride=0"]
    asked = ["check", f"data={name}", f"data.root={tmp_path}", *words.replace("ROOT", str(tmp_path)).split(), *split]
    assert data(asked) == status
    printed = capsys.readouterr()
    assert all(part in printed.out + printed.err for part in said.split("|"))


@pytest.mark.parametrize("name", [*WRITERS, "drivestudio", "kitti", "kitti360", "synthetic"])
def test_conf_has_every_option_of_a_reader_with_its_default(name):
    log = yaml.safe_load((CONF / "data" / f"{name}.yaml").read_text())["log"]
    assert {entry.name for entry in fields(get_class(log.pop("_target_")))} == log.keys()


def test_the_streets_own_defaults_are_those_of_conf():
    keys = composed().data.log.settings
    for field in fields(StreetSettings):
        if isinstance(field.default, LidarSensor):
            assert instantiate(keys[field.name]) == field.default
        elif field.default is not MISSING:
            assert keys[field.name] == (list(field.default) if isinstance(field.default, tuple) else field.default)


def test_classes_of_nuscenes_are_those_of_drivestudios_layout():
    """So that nodes take the same objects of a scene, whichever way it is read."""
    ours, theirs = (
        OmegaConf.to_container(OmegaConf.load(CONF / "data" / f"{name}.yaml").classes)
        for name in ("nuscenes", "drivestudio")
    )
    assert isinstance(ours, dict)
    assert isinstance(theirs, dict)
    for kind, names in theirs.items():
        assert set(ours[kind]) == {name for name in names if "." in name or name == "animal"}
