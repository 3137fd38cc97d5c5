"""`sparsestreet data`: what it looks at, what it makes, and one line on what is wrong."""

from dataclasses import MISSING, fields
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from sparsestreet.cli.commands.data import data
from sparsestreet.cli.config.compose import CONF
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.synthetic import LidarSensor, StreetReader, StreetSettings
from tests.conftest import unchecked
from tests.data.drivestudio.folders import make_nuscenes, make_waymo, write_lines

SMALL = [
    "data.lidar.beams=4",
    "data.lidar.azimuth_steps=40",
    *(
        f"data.log.settings.{setting}"
        for setting in (
            "num_frames=2", "width=32", "height=20", "num_cameras=1", "num_parked_cars=1", "num_moving_cars=0",
            "num_pedestrians=0", "num_cyclists=0",
        )
    ),
]  # fmt: skip


SPLIT = "split.offset=1"
"""Of so few frames the usual split would hold out none."""


@pytest.fixture
def lens(tmp_path) -> Path:
    """A log of 12 frames whose second camera has a lens without inverse, and whose frame 7 lacks its points."""
    make_waymo(tmp_path, frames=12)
    write_lines(tmp_path / "intrinsics/1.txt", [40.0, 40, 20, 12, 0, 0, 1, 1, 0])
    (tmp_path / "lidar/007.bin").unlink()
    return tmp_path


@pytest.mark.parametrize("say", [lambda root: f"{root}", lambda root: f"data.root={root}"])
def test_a_folder_is_checked_as_it_is_or_by_its_key(say, tmp_path, capsys):
    assert data(["check", say(make_nuscenes(tmp_path)), SPLIT]) == 0
    assert "ready to train" in capsys.readouterr().out


def test_a_folder_may_be_named_as_it_likes(tmp_path, capsys):
    odd = tmp_path / "a, b {c} $d 'e'"
    assert data(["check", str(make_nuscenes(odd)), SPLIT]) == 0
    assert "ready to train" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("choice", "count"),
    [
        ([], 2),
        (["data.log.cameras=[0]"], 1),
        (["data.log.last_frame=6"], 1),
        (["data.log.first_frame=8", "data.log.cameras=[0]"], 0),
        (["data.log.last_frame=5", "data.log.cameras=[0]"], 0),
    ],
)
def test_only_what_would_be_read_is_checked(choice, count, lens, capsys):
    assert data(["check", str(lens), *choice, SPLIT]) == (1 if count else 0)
    printed = capsys.readouterr().out
    assert (f"{count} to repair" if count else "ready to train") in printed
    if "data.log.first_frame=8" in choice:
        assert "4 x 1" in printed


def test_the_check_says_what_a_lens_does(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    write_lines(make_waymo(tmp_path) / "intrinsics/1.txt", [40.0, 40, 20, 12, 0.25, 0, 0, 0, 0])
    assert data(["check", str(tmp_path), SPLIT]) == 0
    assert "camera 1: its lens moves pixels by up to" in capsys.readouterr().out


def test_the_size_is_the_one_that_would_be_read(tmp_path, capsys):
    assert data(["check", str(make_nuscenes(tmp_path)), "data.log.width=20", SPLIT]) == 0
    assert "20x12" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check"], "say sparsestreet data check DIR"),
        (["check", "a", "b"], "name one folder"),
        (["check", "a", "data=synthetic"], "name one folder"),
        (["check", "{log}", "data.log.width=41"], "width must be within 1 to 40"),
        (["check", "{log}", "data.log.cameras=[7]"], "cameras [7] must be different ones of the log's [0, 1]"),
        (["check", "{log}", "data.log.last_frme=3"], "no key 'data.log.last_frme'"),
        (["make", "data=drivestudio", "data.root={log}"], "only data=synthetic can be made"),
        (["make", "data.log.settings.width=-5"], "StreetSettings.width must be positive but is -5"),
        (["make", *SMALL, "data.log.root={log}"], "holds something else"),
    ],
)
def test_a_wrong_command_is_answered_in_one_line(arguments, words, tmp_path, capsys):
    log = make_nuscenes(tmp_path)
    assert data([argument.replace("{log}", str(log)) for argument in arguments]) == 2
    written = capsys.readouterr()
    assert words in written.err
    assert written.err.startswith(f"sparsestreet data {arguments[0]}: ")
    assert written.err.count("\n") == 1
    assert written.out in ("", f"data=drivestudio, as {log}/images/000_0.jpg tells\n")


def test_streets_of_other_settings_lie_beside_each_other(tmp_path, capsys):
    with unchecked():
        for choice in ([], ["data.log.settings.ego_speed=5.0"], []):
            assert data(["make", *SMALL, f"data.log.parent={tmp_path}", *choice]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(": ")[2] for line in lines] == ["2 frames of 1 camera"] * 3
    folders = [line.partition(":")[0] for line in lines]
    assert folders[0] == folders[2]
    assert {Path(folder) for folder in folders} == set(tmp_path.iterdir())
    assert len(set(folders)) == 2


def test_a_street_is_checked_like_a_log(tmp_path, capsys):
    with unchecked():
        assert data(["check", "data=synthetic", *SMALL, f"data.log.root={tmp_path / 'mine'}", SPLIT]) == 0
    assert "2 x 1" in capsys.readouterr().out
    assert (tmp_path / "mine/images/000_0.jpg").is_file()
    (tmp_path / "mine/images/000_0.jpg").unlink()
    assert data(["check", "data=synthetic", *SMALL, f"data.log.root={tmp_path / 'mine'}"]) == 1


@pytest.mark.parametrize(
    ("choice", "reader"),
    [("synthetic", StreetReader), ("synthetic", StreetSettings), ("drivestudio", DriveStudioReader)],
)
def test_every_choice_of_a_reader_is_a_key_with_the_readers_own_default(choice, reader):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        log = compose("train", [f"data={choice}", "seed=0"]).data.log
    keys = log.settings if reader is StreetSettings else log
    assert set(keys) == {"_target_"} | {field.name for field in fields(reader)}
    for field in fields(reader):
        if isinstance(field.default, LidarSensor):
            assert instantiate(keys[field.name]) == field.default
        elif field.default is not MISSING:
            assert keys[field.name] == (list(field.default) if isinstance(field.default, tuple) else field.default)


@pytest.mark.parametrize(("arguments", "status"), [([], 2), (["look"], 2), (["--help"], 0), (["check", "--help"], 0)])
def test_usage(arguments, status, capsys):
    assert data(arguments) == status
    assert "sparsestreet data check DIR" in capsys.readouterr().out
