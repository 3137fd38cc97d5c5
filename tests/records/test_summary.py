"""Records on disk: round trip, strictness, atomicity."""

import csv
import dataclasses
import json
import os
from dataclasses import astuple
from pathlib import Path
from typing import Any

import pytest

from sparsestreet.metrics.definitions import DEFINITIONS
from sparsestreet.records.costs import COSTS, STEP_PHASES, CostRecord, StepPhase
from sparsestreet.records.curves import HELD_OUT_CURVE, LEDGER, LOGGED, CountChange, HeldOutLook
from sparsestreet.records.file import JsonFile
from sparsestreet.records.run import FAILURE, RUN, FailedRun, read_failures
from sparsestreet.records.strict_json import RecordError, significant, write_atomically
from sparsestreet.records.summary import (
    HELD_OUT,
    LATENCY,
    NOVEL,
    PRESETS,
    QUALITY,
    SUMMARY,
    TRAINING,
    ClockRow,
    FrameQuality,
    Latency,
    MetricSummary,
    NovelRecord,
    NovelShift,
    Percentiles,
    PresetRecord,
    RegionQuality,
    RenderedAs,
    camera_means,
    clock_rows,
    summarize,
)
from tests.evaluation.frames import NOISE, make_image, make_run, make_summary

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


SHIFT = NovelShift(offset=-1.5, views=6, distances={"fid": 42.5}, truth={"psnr_human": 20.5}, true_views=5)
NEXT_TO_IT = NovelRecord(command="n", ramp=True, real_views=7, absent="no weights", shifts=(SHIFT,))
NO_COSTS = CostRecord(phases={}, step_ms={}, passes={}, frame_ms={}, nodes={}, effects={})


def test_summary_round_trip(tmp_path):
    cameras = {"0": {"psnr_full": 25.0, "psnr_near_lidar": None}, "10": {"psnr_full": 24.0, "psnr_near_lidar": 23.5}}
    summary = make_summary(training_seconds=None, vehicle_psnr=None, cameras=cameras)
    path = tmp_path / "records" / "summary.json"
    SUMMARY.write(tmp_path, summary)
    assert SUMMARY.read(tmp_path) == summary
    assert json.loads(path.read_text())["latency"]["clocks"]["frame"]["p90"] == 60.0
    assert json.loads(path.read_text())["by_camera"] == {HELD_OUT: cameras}


def test_run_description_round_trip(tmp_path):
    config = {"loss.weight": 0.012345678901, "node": ["background", "rigid"], "data.width": None, "sky.on": True}
    run = make_run("streetgs+paper", config=config, caps={"background": 130000}, training_seconds=12.5)
    RUN.write(tmp_path / "run", run)
    assert RUN.path(tmp_path / "run") == tmp_path / "run" / "run.json"
    again = RUN.read(tmp_path / "run")
    assert again == run  # settings with all their digits, ints as ints
    assert [type(value) for value in again.config.values()] == [type(value) for value in run.config.values()]
    # A summary holds it unchanged, and measurements with six digits.
    SUMMARY.write(tmp_path / "run", dataclasses.replace(make_summary(psnr=25.123456789), run=run))
    entries = json.loads(SUMMARY.path(tmp_path / "run").read_text())
    assert entries["run"] == json.loads(RUN.path(tmp_path / "run").read_text())
    assert (entries["run"]["format"], entries["run"]["label"]) == (2, "streetgs+paper")
    assert entries["quality"]["held_out"]["psnr_full"]["mean"] == 25.1235
    assert (significant(1234567.0, "x"), significant(1.23456789e-5, "x")) == (1234570.0, 1.23457e-5)


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
        (NOVEL, NEXT_TO_IT, "format 0, this version reads 2: evaluate again with novel"),
        (COSTS, NO_COSTS, "format 0, this version reads 1: train the run again"),
    ],
    ids=["run", "summary", "novel", "cost"],
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


def drop(entries, key):
    del entries[key]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda entries: drop(entries, "images"), r"lacks the keys \['images'\]"),
        (lambda entries: entries.update(extra=1), r"unknown keys \['extra'\]"),
        (lambda entries: entries["images"].update(held_out="six"), r"images: held_out: expected int, got str 'six'"),
        (lambda entries: entries["images"].update(held_out=True), r"images: held_out: expected int, got bool"),
        (lambda entries: entries.update(gaussians_total=5), r"gaussians_total is 5, its parts sum to 1200"),
        (
            lambda entries: entries["guards"].update(rows={"vanished": 0}, alarms={"vanished": 0}),
            r"alarms holds vanished: 0, rows has 0: evaluate again",
        ),
        (
            lambda entries: entries["latency"]["clocks"]["rig"].update(p50=None),
            r"latency: clocks: rig: p50: expected float, got NoneType",
        ),
        (lambda entries: drop(entries["latency"]["clocks"], "raster"), r"has the clocks raster, frame, rig, got"),
        (lambda entries: entries["latency"]["removed"].update(frame=entries["latency"]["clocks"]["rig"]), "removed Ga"),
        (lambda entries: entries["run"]["noise"].update(quiet=1), r"noise: quiet: expected bool"),
        (lambda entries: entries.update(resolutions=[64]), r"resolutions\[0\]: expected str, got int 64"),
        (
            lambda entries: entries["by_camera"]["held_out"]["0"].update(psnr_full="25"),
            r"by_camera: held_out: 0: psnr_full: expected float, got str '25'",
        ),
        (lambda entries: entries.update(bytes_total=1), r"bytes_total is 1"),
        (lambda entries: entries.update(format=99), r"format 99, this version reads 4"),
        (lambda entries: entries["run"].update(format=99), r"run: the record has format 99, .* train the run again"),
        (lambda entries: entries["run"]["config"].update(a={}), r"run: config: a: expected one of bool, .* got dict"),
        (lambda entries: entries["guards"]["alarms"].update(vanished=1), r"alarms holds vanished: 1, rows has N"),
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


TABLES = [
    (
        HELD_OUT_CURVE,
        "curves/held_out.csv",
        [HeldOutLook(1.5, 10, 20.25, None, 22.75), HeldOutLook(12.125, 25, None, 21.5, None)],
        "seconds,step,psnr_full,psnr_human,psnr_vehicle\n1.500,10,20.2500,,22.7500\n12.125,25,,21.5000,\n",
    ),
    (
        STEP_PHASES,
        "records/phases.csv",
        [StepPhase(47, "splat", 1.25), StepPhase(94, "loss sky", 0.0625)],
        "step,phase,milliseconds\n47,splat,1.2500\n94,loss sky,0.0625\n",
    ),
    (
        LEDGER,
        "records/counts.csv",
        [CountChange(3, "rigid", 20, 15, "mask"), CountChange(7, "background", 100, 130, "densify")],
        "step,node,before,after,reason\n3,rigid,20,15,mask\n7,background,100,130,densify\n",
    ),
    (
        LATENCY,
        "records/latency.csv",
        [
            ClockRow("frame", "masked", Percentiles(1.5, 2.5, 3.5, 7)),
            ClockRow("rig", "removed", Percentiles(4.0, 5.0, 6.0, 8)),
        ],
        "clock,rows,p50,p90,p99,repeats\nframe,masked,1.5,2.5,3.5,7\nrig,removed,4.0,5.0,6.0,8\n",
    ),
]


@pytest.mark.parametrize(("file", "name", "rows", "text"), TABLES, ids=[name for _, name, _, _ in TABLES])
def test_a_table_is_read_as_it_was_written(tmp_path, file, name, rows, text):
    """And a cell that is no number is named."""
    file.write(tmp_path, rows)
    assert file.path(tmp_path) == tmp_path / name
    assert (tmp_path / name).read_text() == text
    assert file.read(tmp_path) == rows
    header, first = text.splitlines()[:2]
    number = next(cell for cell in first.split(",") if cell.replace(".", "").isdigit())
    (tmp_path / name).write_text(f"{header}\n{first.replace(number, 'soon', 1)}\n")
    with pytest.raises(RecordError, match=r"line 2: .*soon.*; (train|evaluate) the run again"):
        file.read(tmp_path)


def test_clocks_are_of_all_gaussians_or_of_masked_and_removed_ones():
    def clocks(first: float) -> dict[str, Percentiles]:
        return {name: Percentiles(first + place, 8.0, 9.0, 3) for place, name in enumerate(("raster", "frame", "rig"))}

    plain = Latency(clocks(1.0), {}, 20, 6, "d", 2, NOISE)
    assert [(row.clock, row.gaussians, row.percentiles.p50) for row in clock_rows(plain)] == [
        ("raster", "all", 1.0), ("frame", "all", 2.0), ("rig", "all", 3.0),
    ]  # fmt: skip
    masked = Latency(clocks(1.0), clocks(4.0), 20, 6, "d", 2, NOISE)
    assert [(row.clock, row.gaussians, row.percentiles.p50) for row in clock_rows(masked)] == [
        ("raster", "masked", 1.0), ("frame", "masked", 2.0), ("rig", "masked", 3.0),
        ("raster", "removed", 4.0), ("frame", "removed", 5.0), ("rig", "removed", 6.0),
    ]  # fmt: skip
    assert masked.p50 == 2.0
    assert masked.protocol.startswith("3 renders cycling through 6 views after 20 warm-up renders")
    for broken in ({"raster": clocks(1.0)["raster"]}, clocks(1.0) | {"more": clocks(1.0)["rig"]}):
        with pytest.raises(ValueError, match="a latency has the clocks raster, frame, rig, got"):
            Latency(broken, {}, 20, 6, "d", 2, NOISE)
        with pytest.raises(ValueError, match="of removed Gaussians"):
            Latency(clocks(1.0), broken, 20, 6, "d", 2, NOISE)


def check_written(run: Path, file: JsonFile[Any], name: str, record: Any) -> None:
    file.write(run, record)
    assert (run / name).is_file()
    assert file.read(run) == record


def test_records_beside_the_summary_are_read_as_they_were_written(tmp_path):
    way = RenderedAs(
        preset="fast", trained=True, quality={"psnr_full": 25.5}, psnr_to_exact=50.5, frame_ms=7.5, repeats=9
    )
    presets = PresetRecord(command="p", device="d", threads=3, views=4, noise=NOISE, rendered=(way,))
    failed = FailedRun(label="a+b", seed=4, command="c", error="e", trace="t")
    check_written(tmp_path / "run", NOVEL, "records/novel.json", NEXT_TO_IT)
    check_written(tmp_path / "run", PRESETS, "records/presets.json", presets)
    check_written(tmp_path / "run", FAILURE, "failed.json", failed)
    assert read_failures(tmp_path) == [(tmp_path / "run", failed)]


def test_a_truth_has_known_metrics_alone(tmp_path):
    """The error names the place in the file."""
    with pytest.raises(ValueError, match="truth holds psnr_near, psnr_sky, expected psnr_full, psnr_human, psnr_veh"):
        dataclasses.replace(SHIFT, truth={"psnr_sky": 1.0, "psnr_near": 2.0})
    NOVEL.write(tmp_path, NEXT_TO_IT)
    path = NOVEL.path(tmp_path)
    path.write_text(path.read_text().replace("psnr_human", "psnr_sky"))
    with pytest.raises(RecordError, match=r"novel\.json: shifts\[0\]: truth holds psnr_sky, expected psnr_full, "):
        NOVEL.read(tmp_path)


def test_what_training_logged_keeps_every_column(tmp_path):
    assert LOGGED.rows(tmp_path) == []
    LOGGED.write(tmp_path, [{"step": "9", "psnr": "20"}, {"step": "19", "val/psnr": "18,5", "a\nb": ""}])
    path = tmp_path / "curves" / "metrics.csv"
    assert path.read_bytes() == b'step,psnr,val/psnr,"a\nb"\n9,20,,\n19,,"18,5",\n'
    path.write_bytes(b'step,psnr\r\n9,"2\r\n0"\r\n')
    assert LOGGED.rows(tmp_path) == [{"step": "9", "psnr": "2\r\n0"}]  # a line of a cell is no line of the table


def image(frame: int, camera: int, first: float, **more: float | None) -> FrameQuality:
    values = dict(zip(("mse", "psnr", "ssim_uniform7", "psnr8", "ssim_gauss11", "lpips_alex", "lpips_vgg"),
                      (first + place for place in range(7)), strict=True))  # fmt: skip
    full = RegionQuality(108, **(values | more))
    return FrameQuality(frame, camera, 12, 9, {"full": full, "sky": full})


def test_summaries_are_over_the_images_that_have_a_metric():
    """Two of three have LPIPS; a PSNR of 100 dB and more counts as capped, an MSE does not."""
    images = [image(0, 1, 99.0), image(1, 2, 100.0, lpips_alex=None), image(2, 1, 102.0, psnr8=None)]
    found = summarize(images)
    assert list(found) == list(DEFINITIONS)
    sd = (7 / 3) ** 0.5
    for name, expected in (
        ("mse_full", (301 / 3, sd, 3, 0)),
        ("psnr_full", (304 / 3, sd, 3, 3)),
        ("psnr8_full", (102.5, 0.5**0.5, 2, 2)),
        ("lpips_alex_full", (105.5, 4.5**0.5, 2, 0)),
    ):
        assert astuple(found[name]) == pytest.approx(expected), name
    assert found["psnr_human"] == MetricSummary(None, None, 0, 0)
    assert summarize(images[:1])["psnr_full"] == MetricSummary(100.0, None, 1, 1)
    assert summarize([image(0, 0, 98.5)])["psnr_full"].capped == 0
    assert (images[0].value("psnr", "full"), images[0].value("psnr", "human")) == (100.0, None)
    assert (images[0].pixels("full"), images[0].pixels("human")) == (108, 0)


def test_cameras_have_means_of_their_own():
    found = camera_means([image(0, 10, 20.0), image(1, 2, 30.0), image(2, 10, 24.0)])
    assert list(found) == ["2", "10"]
    assert (found["2"]["psnr_full"], found["10"]["psnr_full"]) == (31.0, 23.0)
    assert found["2"]["psnr_vehicle"] is None
