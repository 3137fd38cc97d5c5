"""Records on disk: round trip, strictness, atomicity."""

import csv
import dataclasses
import json
import os

import pytest

from sparsestreet.records.run import RUN
from sparsestreet.records.strict_json import RecordError, significant, write_atomically
from sparsestreet.records.summary import (
    HELD_OUT,
    QUALITY,
    SUMMARY,
    TRAINING,
    FrameQuality,
    GuardCounts,
    MetricSummary,
    RegionQuality,
)
from tests.evaluation.frames import make_image, make_run, make_summary

IMAGES = [
    FrameQuality(0, 1, 12, 9, {"full": RegionQuality(108, 0.00123456, 29.0849, 0.912345)}),
    FrameQuality(
        10,
        0,
        12,
        9,
        {
            "full": RegionQuality(108, 0.0, 100.0, 1.0, 60.5, 0.99, 0.125, 0.25),
            "human": RegionQuality(0, None, None, None),
            "vehicle": RegionQuality(7, 0.5, 3.0103, -0.25),
            "near_lidar": RegionQuality(100, 0.125, 9.0309, 0.5),
            "beyond_lidar": RegionQuality(0, None, None, None),
        },
    ),
]


def test_summary_round_trip(tmp_path):
    cameras = {"0": {"psnr_full": 25.0, "psnr_near_lidar": None}, "10": {"psnr_full": 24.0, "psnr_near_lidar": 23.5}}
    summary = make_summary(training_seconds=None, vehicle_psnr=None, cameras=cameras)
    path = tmp_path / "records" / "summary.json"
    SUMMARY.write(tmp_path, summary)
    assert SUMMARY.read(tmp_path) == summary
    assert json.loads(path.read_text())["latency"]["clocks"]["frame"]["p90"] == 60.0
    assert json.loads(path.read_text())["by_camera"] == {HELD_OUT: cameras}
    assert (summary.camera_mean("psnr_near_lidar", "10"), summary.camera_mean("psnr_full", "3")) == (23.5, None)


def test_run_description_round_trip(tmp_path):
    config = {"loss.weight": 0.012345678901, "node": ["background", "rigid"], "data.width": None, "sky.on": True}
    run = make_run("streetgs+paper", config=config, caps={"background": 130000}, training_seconds=12.5)
    RUN.write(tmp_path / "run", run)
    assert RUN.path(tmp_path / "run") == tmp_path / "run" / "run.json"
    again = RUN.read(tmp_path / "run")
    assert again == run  # settings with all their digits, ints as ints
    assert [type(value) for value in again.config.values()] == [type(value) for value in run.config.values()]


def test_a_summary_holds_the_run_unchanged(tmp_path):
    summary = make_summary(config={"loss.weight": 0.012345678901})
    SUMMARY.write(tmp_path, summary)
    RUN.write(tmp_path, summary.run)
    entries = json.loads(SUMMARY.path(tmp_path).read_text())["run"]
    assert entries == json.loads(RUN.path(tmp_path).read_text())
    assert (entries["format"], entries["label"], entries["sparsify"]) == (2, "plain", "none")


def test_the_main_split_is_the_held_out_one_where_there_is_one():
    both, training = make_summary(training_psnr=31.0), make_summary(psnr=None, training_psnr=31.0)
    assert (both.main_split, both.mean("psnr_full"), both.mean("psnr_full", TRAINING)) == (HELD_OUT, 25.0, 31.0)
    assert (training.main_split, training.mean("psnr_full"), training.mean("psnr_full", HELD_OUT)) == (
        TRAINING,
        31.0,
        None,
    )
    assert both.mean("psnr_human") is None


def test_a_record_of_no_view_or_of_an_unknown_split_is_refused():
    with pytest.raises(ValueError, match=r"splits \[\], .* images of \[\], expected held_out, training or both"):
        make_summary(psnr=None)
    with pytest.raises(ValueError, match=r"splits \['test'\]"):
        dataclasses.replace(make_summary(), quality={"test": {}}, images={"test": 0})
    with pytest.raises(ValueError, match=r"images of \['training'\]"):
        dataclasses.replace(make_summary(), images={TRAINING: 3})
    with pytest.raises(ValueError, match=r"by_camera of \['training'\]"):
        dataclasses.replace(make_summary(), by_camera={TRAINING: {}})


@pytest.mark.parametrize(
    ("file", "value", "remedy"),
    [
        (RUN, make_run(), "format 0, this version reads 2: train the run again"),
        (SUMMARY, make_summary(), "format 0, this version reads 4: evaluate again"),
    ],
    ids=["run", "summary"],
)
def test_another_format_is_named_before_its_keys(tmp_path, file, value, remedy):
    path = file.path(tmp_path)
    file.write(tmp_path, value)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 0, "new key": 1}))
    with pytest.raises(RecordError, match=remedy):
        file.read(tmp_path)
    path.write_text("{}")
    with pytest.raises(RecordError, match="format None"):
        file.read(tmp_path)


def test_floats_are_written_with_six_digits(tmp_path):
    summary = make_summary(psnr=25.123456789)
    SUMMARY.write(tmp_path, summary)
    assert '"mean": 25.1235,' in SUMMARY.path(tmp_path).read_text()
    assert significant(1234567.0, "x") == 1234570.0
    assert significant(1.23456789e-5, "x") == 1.23457e-5


def test_quality_round_trip_and_plain_csv(tmp_path):
    quality = QUALITY[HELD_OUT]
    quality.write(tmp_path, IMAGES)
    assert quality.read(tmp_path) == IMAGES
    with quality.path(tmp_path).open(newline="") as stream:
        first, second = csv.DictReader(stream)
    assert (first["frame"], first["camera"], first["psnr_full"]) == ("0", "1", "29.0849")
    assert (second["psnr8_full"], second["lpips_alex_full"], second["lpips_vgg_full"]) == ("60.5", "0.125", "0.25")
    assert (first["lpips_alex_full"], "lpips_alex_near_lidar" in first) == ("", False)
    assert first["pixels_vehicle"] == first["psnr_vehicle"] == ""
    assert (second["pixels_human"], second["psnr_human"], second["ssim_uniform7_vehicle"]) == ("0", "", "-0.25")
    assert (second["psnr_near_lidar"], second["pixels_beyond_lidar"], second["mse_beyond_lidar"]) == ("9.0309", "0", "")
    assert first["pixels_near_lidar"] == ""
    quality.write(tmp_path, [])
    assert quality.read(tmp_path) == []
    names = [QUALITY[split].path(tmp_path).relative_to(tmp_path).as_posix() for split in (HELD_OUT, TRAINING)]
    assert names == ["records/quality.csv", "records/quality_train.csv"]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_no_record_holds_a_number_that_is_none(tmp_path, value):
    summary = make_summary()
    broken = dataclasses.replace(summary, quality={HELD_OUT: {"psnr_full": MetricSummary(value, None, 1, 0)}})
    with pytest.raises(RecordError, match=r"summary\.json: quality: held_out: psnr_full: mean is (nan|inf)"):
        SUMMARY.write(tmp_path, broken)
    with pytest.raises(RecordError, match=r"quality\.csv: frame 3 is (nan|inf)"):
        QUALITY[HELD_OUT].write(tmp_path, [make_image(3, vehicle=RegionQuality(64, value, 20.0, 0.5))])
    assert list(tmp_path.iterdir()) == []


def test_totals_must_be_the_sum_of_their_parts():
    with pytest.raises(ValueError, match="gaussians_total is 5, its parts sum to 1200"):
        dataclasses.replace(make_summary(), gaussians_total=5)


def test_alarms_are_among_the_guards():
    with pytest.raises(ValueError, match="alarms holds vanished: 3, rows has None: evaluate again"):
        GuardCounts({"drawn": 5}, {"vanished": 3})
    with pytest.raises(ValueError, match="alarms holds vanished: 0, rows has 0"):
        GuardCounts({"vanished": 0}, {"vanished": 0})


def drop(entries, key):
    del entries[key]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda entries: drop(entries, "images"), r"lacks the keys \['images'\]"),
        (lambda entries: entries.update(extra=1), r"unknown keys \['extra'\]"),
        (lambda entries: entries["images"].update(held_out="six"), r"images: held_out: expected int, got str 'six'"),
        (lambda entries: entries["images"].update(held_out=True), r"images: held_out: expected int, got bool"),
        (
            lambda entries: entries["latency"]["clocks"]["rig"].update(p50=None),
            r"latency: clocks: rig: p50: expected float, got NoneType",
        ),
        (lambda entries: drop(entries["latency"]["clocks"], "raster"), r"has the clocks raster, frame, rig, got"),
        (lambda entries: entries["latency"]["removed"].update(frame=entries["latency"]["clocks"]["rig"]), "removed Ga"),
        (lambda entries: entries["run"]["noise"].update(quiet=1), r"noise: quiet: expected bool"),
        (lambda entries: entries.update(resolutions=[64]), r"resolutions\[0\]: expected str, got int 64"),
        (
            lambda entries: entries["quality"]["held_out"]["psnr_full"].update(images=1.5),
            r"psnr_full: images: expected int",
        ),
        (
            lambda entries: entries["by_camera"]["held_out"]["0"].update(psnr_full="25"),
            r"by_camera: held_out: 0: psnr_full: expected float, got str '25'",
        ),
        (lambda entries: drop(entries, "by_camera"), r"lacks the keys \['by_camera'\]"),
        (lambda entries: entries.update(bytes_total=1), r"bytes_total is 1"),
        (lambda entries: entries.update(format=99), r"format 99, this version reads 4"),
        (lambda entries: entries["run"].update(format=99), r"run: the record has format 99, .* train the run again"),
        (lambda entries: entries["run"]["config"].update(a={}), r"run: config: a: expected one of bool, .* got dict"),
        (lambda entries: entries["run"].update(training_seconds="1"), r"training_seconds: expected float, got str '1'"),
        (lambda entries: entries["guards"]["alarms"].update(vanished=1), r"alarms holds vanished: 1, rows has N"),
        (lambda entries: drop(entries["guards"], "alarms"), r"guards: GuardCounts lacks the keys \['alarms'\]"),
        (lambda entries: entries["evaluated"].update(machine=[]), r"evaluated: machine: expected dict, got list"),
        (lambda entries: entries["run"].update(seed=float("nan")), r"is not strict JSON \(NaN"),
    ],
)
def test_a_malformed_summary_names_file_and_entry(tmp_path, damage, message):
    path = SUMMARY.path(tmp_path)
    SUMMARY.write(tmp_path, make_summary())
    entries = json.loads(path.read_text())
    damage(entries)
    path.write_text(json.dumps(entries))
    with pytest.raises(RecordError, match=r"summary\.json.*" + message):
        SUMMARY.read(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "\x00"])
def test_a_broken_summary_names_the_file(tmp_path, text):
    write_atomically(SUMMARY.path(tmp_path), text)
    with pytest.raises(RecordError, match=r"summary\.json"):
        SUMMARY.read(tmp_path)
    with pytest.raises(RecordError, match=r"absent/records/summary\.json: cannot be read"):
        SUMMARY.read(tmp_path / "absent")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1,0,8,8,64,0.1", "line 3: 6 cells, expected 60"),
        ("1,0,8,8,64,0.1,ten,0.5" + 52 * ",", "line 3: .*ten"),
        ("1,0,8,8,64,0.1,nan,0.5" + 52 * ",", "line 3: a metric is not a finite number"),
        ("1,0,8,8" + 56 * ",", "line 3: the metrics of the full image are missing"),
    ],
)
def test_a_malformed_quality_names_file_and_line(tmp_path, line, message):
    QUALITY[HELD_OUT].write(tmp_path, IMAGES[:1])
    path = QUALITY[HELD_OUT].path(tmp_path)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(RecordError, match=r"quality\.csv, " + message):
        QUALITY[HELD_OUT].read(tmp_path)


def test_quality_with_another_header_is_refused(tmp_path):
    write_atomically(QUALITY[HELD_OUT].path(tmp_path), "frame,psnr\n0,20\n")
    with pytest.raises(RecordError, match=r"quality\.csv: the header .* evaluate the run again"):
        QUALITY[HELD_OUT].read(tmp_path)
    with pytest.raises(RecordError, match=r"quality_train\.csv: does not exist; evaluate the run first"):
        QUALITY[TRAINING].read(tmp_path)


def test_a_crash_while_writing_leaves_the_old_file_alone(tmp_path, monkeypatch):
    path = tmp_path / "summary.json"
    write_atomically(path, "old")

    def crash(source, target):
        assert (source.read_text(), path.read_text()) == ("new", "old")  # whole before it takes the name
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, "new")
    assert [entry.name for entry in tmp_path.iterdir()] == ["summary.json"]
    assert path.read_text() == "old"
