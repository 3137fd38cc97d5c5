"""A stranger's table on the command line: what it says of itself, and whether a row of it comes out again."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from sparsestreet.cli.commands.report import report
from sparsestreet.cli.runs.folder import TRACKS_FILE
from sparsestreet.records.configuration import config_hash
from sparsestreet.records.summary import HELD_OUT, QUALITY, SUMMARY, RunSummary, camera_means, summarize
from sparsestreet.report.bundle import SCENE, TRACKS, write_bundle
from sparsestreet.report.collect import RunRecord, collect
from sparsestreet.scene.storage import STREET_FILE
from tests.evaluation.frames import make_summary
from tests.report.bundles import changed, members, two_runs


def test_names_in_a_bundle_are_those_of_a_run():
    assert (SCENE, TRACKS) == (STREET_FILE, TRACKS_FILE)


def test_a_bundle_is_written_and_checked(tmp_path, capsys):
    runs, path = two_runs(tmp_path / "runs"), tmp_path / "table.zip"
    assert report([str(runs), "baseline=streetgs", "protocol=strict", f"bundle={path}"]) == 0
    assert f"{path}: 2 runs, 0.01 MB; sparsestreet report verify {path} checks it" in capsys.readouterr().out
    assert report(["verify", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}: 2 runs, whose bytes, records and tables agree\n"
    changed(path, "tables.md", lambda text: text.replace("25.74", "26.74").replace("streetgs", "ours"), rehash=False)
    assert report(["verify", str(path)]) == 1
    said = capsys.readouterr()
    assert said.out.splitlines()[0].startswith("tables.md has the SHA-256")
    assert len(said.out.splitlines()) == 2
    assert said.err == f"sparsestreet report verify: {path} does not hold: 2 of its parts disagree\n"


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["nowhere.zip"], 1, "there is no nowhere.zip: name a bundle"),
        (["{bundle}", "row=5"], 2, "no rows are named '5': say its number, of 1: streetgs, street, seed 0; 2: "),
        (["{bundle}", "evaluate=true"], 2, "go with a row"),
        (["{bundle}", "data.root=x"], 2, "data.root=x goes with a row"),
        (["row=1"], 2, "bundle=... is missing: sparsestreet report verify FILE.zip"),
    ],
)
def test_slips_are_one_line(tmp_path, capsys, words, status, said):
    path = tmp_path / "table.zip"
    write_bundle(collect([two_runs(tmp_path / "runs")]), path, protocol="drivestudio")
    assert report(["verify", *(word.format(bundle=path) for word in words)]) == status
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_options_of_writing(tmp_path, capsys):
    assert report([str(tmp_path), "scenes=true"]) == 2
    assert report([str(tmp_path), "bundle=a.tar"]) == 2
    assert "bundle must end in .zip, got 'a.tar'" in capsys.readouterr().err


def row_of(tmp_path: Path, run: RunSummary) -> Path:
    """A bundle of one run."""
    SUMMARY.write(tmp_path / "run", run)
    write_bundle([RunRecord(tmp_path / "run", run)], tmp_path / "row.zip", protocol="drivestudio")
    return tmp_path / "row.zip"


HOSTILE = {
    "a class": ("+callback.x._target_=os.system", "os.system"),
    "a folder": ("callback.row_ledger.path=/etc/x", "does not choose where it writes"),
    "a flag": ("--config-dir=/x", "chooses no flag"),
    "Hydra's": ("hydra.searchpath=[file:///x]", "nothing of Hydra's"),
    "a resolver": ("+data.x=${{oc.env:HOME}}", "which asks for what conf/ never asks for"),
    "another program": None,
}


@pytest.mark.lengthy
@pytest.mark.parametrize("case", HOSTILE)
def test_the_words_of_a_stranger_run_nothing(tmp_path, capsys, case):
    if HOSTILE[case] is None:
        command, said = "rm -rf /", "was not made by sparsestreet train"
    else:
        word, said = HOSTILE[case]
        command = f"sparsestreet train seed=0 '{word.replace('{{', '{').replace('}}', '}')}'"
    assert report(["verify", str(row_of(tmp_path, make_summary(command=command))), "row=1"]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert "row.zip, row 1" in error
    assert error.count("\n") == 1


@pytest.fixture
def typed(tiny_street) -> list[str]:
    """Words of this machine: where the street lies, and answers about it."""
    return [word for word in tiny_street if word.startswith(("data.log.root=", "cache="))]


@pytest.fixture
def copied(finished, tmp_path) -> Path:
    return shutil.copytree(finished, tmp_path / "runs/finished", ignore=shutil.ignore_patterns("checkpoints"))


@pytest.mark.lengthy
def test_a_row_trained_again_holds_to_the_bit(copied, typed, tmp_path, capsys):
    path, out = tmp_path / "table.zip", tmp_path / "again"
    assert report([str(copied.parent), f"bundle={path}"]) == 0
    capsys.readouterr()
    assert report(["verify", str(path), "row=1", f"out={out}", *typed]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("row 1, streetgs+removal, ")
    assert line.endswith(", as recorded: holds")
    assert "recorded " not in line.replace("as recorded", "")


def with_psnr(run: Path, more: float) -> None:
    """Somebody adds so many dB to every image of a record, and to the means."""
    images = [
        replace(
            image,
            regions={**image.regions, "full": replace(image.regions["full"], psnr=image.value("psnr", "full") + more)},
        )
        for image in QUALITY[HELD_OUT].read(run)
    ]
    QUALITY[HELD_OUT].write(run, images)
    summary = SUMMARY.read(run)
    quality, cameras = {HELD_OUT: summarize(images)}, {HELD_OUT: camera_means(images)}
    SUMMARY.write(run, replace(summary, quality=summary.quality | quality, by_camera=summary.by_camera | cameras))


@pytest.mark.slow
def test_a_record_that_was_changed_and_hashed_again_does_not_hold(copied, typed, tmp_path, capsys):
    with_psnr(copied, 0.5)
    path = tmp_path / "table.zip"
    assert report([str(copied.parent), f"bundle={path}"]) == 0
    assert report(["verify", str(path)]) == 0
    assert report(["verify", str(path), "row=1", f"out={tmp_path / 'again'}", *typed]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert "± 0.050 dB): DOES NOT HOLD; " in error
    assert error.count("DOES NOT HOLD") == 1


@pytest.mark.slow
def test_a_scene_that_goes_along_is_measured_instead(copied, typed, tmp_path, capsys):
    path, out = tmp_path / "table.zip", tmp_path / "measured"
    assert report([str(copied.parent), f"bundle={path}", "scenes=true"]) == 0
    assert "runs/0001/scene.street" in members(path)
    assert report(["verify", str(path), "row=1", "evaluate=true", f"out={out}", *typed]) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith(": holds")
    assert (out / "records/summary.json").is_file()
    with_psnr(copied, 0.5)
    assert report([str(copied.parent), f"bundle={path}", "scenes=true"]) == 0
    assert report(["verify", str(path), "row=1", "evaluate=true", f"out={tmp_path / 'b'}", *typed]) == 1
    assert capsys.readouterr().err.count("DOES NOT HOLD") == 1


@pytest.mark.slow
def test_other_data_another_configuration_and_seed_are_refused(copied, typed, tmp_path, capsys):
    summary = SUMMARY.read(copied)
    config = summary.run.config | {"schedule.lambda_m": 3.0}
    for change, said in (
        ({"data_hash": "f" * 12}, "was made of data with the hash ffffffffffff, "),
        (
            {"config": config, "config_hash": config_hash(config)},
            "in 1 options: schedule.lambda_m (3.0 in the record, ",
        ),
        ({"seed": 7, "config": summary.run.config | {"seed": 7}}, "in 1 options: seed (7 in the record, 0 here)"),
        ({"steps": 30}, "was ended by a clock or a signal at step 30"),
    ):
        path = row_of(tmp_path, replace(summary, run=replace(summary.run, **change)))
        assert report(["verify", str(path), "row=1", f"out={tmp_path / 'again'}", *typed]) == 1
        assert said in capsys.readouterr().err
    path = row_of(tmp_path, summary)
    assert report(["verify", str(path), "row=1", "shedule.x=1"]) == 1
    assert "did you mean 'schedule" in capsys.readouterr().err
    assert not (tmp_path / "again").exists()
