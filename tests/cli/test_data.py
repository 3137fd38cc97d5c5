"""``sparsestreet data``: what it looks at, makes and converts, and one line on what is wrong."""

import json
from collections.abc import Iterable, Iterator

import pytest

from sparsestreet.cli.commands import data as module
from sparsestreet.cli.commands.data import data
from sparsestreet.data.convert import LogFile, partial_folder
from sparsestreet.data.drivestudio import DriveStudioReader
from tests.data.drivestudio.folders import make_nuscenes, make_waymo

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


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check"], "say sparsestreet data check DIR"),
        (["check", "{log}", "data.log.width=41"], "width must be within 1 to 40"),
        (["check", "{log}", "data.log.last_frme=3"], "no key 'data.log.last_frme'"),
        (["make", "data=drivestudio", "data.root={log}"], "only data=synthetic can be made"),
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


def converted(*words: str) -> int:
    return data(["convert", *words])


def test_the_short_form_finds_the_reader_and_writes_drivestudios_layout(tmp_path, capsys):
    log, out = make_waymo(tmp_path / "a log, {odd}"), tmp_path / "out"
    assert converted(f"from={log}", f"to={out}") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"data=drivestudio, as {log}/images/000_0.jpg tells"
    place = lines.index(f"{out}: 43 files, 0.0 MB, 3 frames of 2 cameras")
    assert "43 of 43 files" in lines[place - 1]
    assert lines[place + 1] == "  lost or changed: images become JPEG of quality 95"
    assert lines[place + 2].startswith("  note: the flavor is waymo, which has cameras that are rigid on a vehicle; ")
    assert lines[place + 3].startswith("  note: DriveStudio takes sizes of images from datasets/dataset_meta.py")
    assert (out / "ego_pose/002.txt").is_file()  # as the log, Waymo's flavor
    assert DriveStudioReader(out).check() == []


def test_the_part_and_the_settings_are_chosen_by_keys(tmp_path, capsys):
    log, out = make_nuscenes(tmp_path / "log"), tmp_path / "out"
    part = ["data.log.cameras=[1]", "data.log.last_frame=1", "data.log.width=20"]
    words = ["data=drivestudio", f"data.root={log}", *part, "jpeg_quality=null"]
    assert converted(*words, f"to={out}") == 0
    assert {path.name for path in (out / "images").iterdir()} == {"000_1.jpg", "001_1.jpg"}
    assert (out / "images/000_1.jpg").read_bytes().startswith(b"\x89PNG")
    said = json.loads((out / "conversion.json").read_text())
    assert said["source"]["data_hash"] == DriveStudioReader(log, cameras=[1], last_frame=1).data_hash()
    assert said["source"]["reader"]["width"] == 20
    assert not {"root", "cache_mb"} & set(said["source"]["reader"])
    assert said["settings"] == {"jpeg_quality": None, "flavor": "auto"}
    (line,) = said["losses"]
    assert line.endswith("knows in its flavor nuscenes (objects): Vehicle is vehicle.car (1)")
    printed = capsys.readouterr().out
    assert f"  lost or changed: {line}\n" in printed
    assert all(f"  note: {note}\n" in printed for note in said["notes"])
    assert said["notes"][-1].startswith("DriveStudio reads poses of cameras 0 too, which the log lacks")


def stopped(files: Iterable[LogFile], total: int, what: str) -> Iterator[LogFile]:
    yield from list(files)[:10]
    raise KeyboardInterrupt


def test_after_ctrl_c_the_same_command_goes_on(tmp_path, capsys, monkeypatch):
    words = [f"from={make_nuscenes(tmp_path / 'log')}", f"to={tmp_path / 'out'}"]
    with monkeypatch.context() as patch:
        patch.setattr(module, "shown", stopped)
        assert converted(*words) == 130
    partial = partial_folder(tmp_path / "out")
    assert capsys.readouterr().err == (
        f"sparsestreet data convert: stopped, what is written stays in {partial}: give the same command to go on, or "
        "remove the folder\n"
    )
    assert converted(*words, "data.log.width=20") == 1
    assert "differs in source, notes: remove it, or name another place" in capsys.readouterr().err
    assert converted(*words, "data.log.cache_mb=9") == 0
    assert "files, 10 of them there already, " in capsys.readouterr().out
    assert not partial.exists()


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["to={out}"], 2, "no log is named: say sparsestreet data convert from=DIR to=DIR"),
        (["from={log}"], 2, "to=DIR is missing"),
        (["from={log}", "from={log}", "to={out}"], 2, "from=DIR names one folder"),
        (["from={log}", "data.root={log}", "to={out}"], 2, "name the same: leave one out"),
        (["from={log}", "data=synthetic", "to={out}"], 2, "leave from=... out"),
        (["from={log}", "to={log}/new"], 2, "lies in the log itself"),
        (["from={log}", "to={out}", "layout=kitti"], 2, "no key 'layout'"),
        (["from={log}", "to={out}", "flavor=kitti"], 2, "flavor must be "),
        (["from={log}", "to={out}", "jpeg_quality=200"], 2, "jpeg_quality lies in 1 to 100, got 200"),
        (["from={log}", "to={out}", "data.log.last_frame=30"], 1, "are not within the log's 0 to 2"),
        (["from={log}", "to={full}"], 1, "is no empty folder: name another place with to=..., or remove it"),
        (["from={empty}", "to={out}"], 1, "is an empty folder"),
    ],
)
def test_a_wrong_command_is_answered_and_nothing_is_written(words, status, said, tmp_path, capsys):
    places = {"log": make_nuscenes(tmp_path / "log"), "out": tmp_path / "out", "full": tmp_path / "full"}
    places["empty"] = tmp_path / "empty"
    places["empty"].mkdir()
    places["full"].mkdir()
    (places["full"] / "mine.txt").touch()
    before = set(tmp_path.rglob("*"))
    assert converted(*(word.format(**places) for word in words)) == status
    written = capsys.readouterr().err
    assert said in written
    assert written.startswith("sparsestreet data convert: ")
    assert set(tmp_path.rglob("*")) == before
