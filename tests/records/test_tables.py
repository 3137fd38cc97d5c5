"""Every file of a run holds what was written, value by value, under its own name and header."""

from dataclasses import astuple
from pathlib import Path
from typing import Any

import pytest

from sparsestreet.metrics.definitions import DEFINITIONS
from sparsestreet.records.costs import STEP_PHASES, StepPhase
from sparsestreet.records.curves import HELD_OUT_CURVE, LEDGER, LOGGED, CountChange, HeldOutLook
from sparsestreet.records.file import JsonFile
from sparsestreet.records.renders import NOVEL, PRESETS, NovelRecord, NovelShift, PresetRecord, RenderedAs
from sparsestreet.records.run import FAILURE, FailedRun, read_failures
from sparsestreet.records.strict_json import RecordError
from sparsestreet.records.summary import (
    LATENCY,
    ClockRow,
    FrameQuality,
    Latency,
    MetricSummary,
    Percentiles,
    RegionQuality,
    camera_means,
    clock_rows,
    summarize,
)
from tests.evaluation.frames import NOISE

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
    file.write(tmp_path, rows)
    assert file.path(tmp_path) == tmp_path / name
    assert (tmp_path / name).read_text() == text
    assert file.read(tmp_path) == rows


@pytest.mark.parametrize(("file", "name", "rows", "text"), TABLES, ids=[name for _, name, _, _ in TABLES])
def test_a_cell_that_is_no_number_is_named(tmp_path, file, name, rows, text):
    file.write(tmp_path, rows)
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


SHIFT = NovelShift(offset=-1.5, views=6, distances={"fid": 42.5}, truth={"psnr_human": 20.5}, true_views=5)


def check_written(run: Path, file: JsonFile[Any], name: str, record: Any) -> None:
    file.write(run, record)
    assert (run / name).is_file()
    assert file.read(run) == record


def test_records_beside_the_summary_are_read_as_they_were_written(tmp_path):
    novel = NovelRecord(command="n", ramp=True, real_views=7, absent="no weights", shifts=(SHIFT,))
    way = RenderedAs(
        preset="fast", trained=True, quality={"psnr_full": 25.5}, psnr_to_exact=50.5, frame_ms=7.5, repeats=9
    )
    presets = PresetRecord(command="p", device="d", threads=3, views=4, noise=NOISE, rendered=(way,))
    failed = FailedRun(label="a+b", seed=4, command="c", error="e", trace="t")
    check_written(tmp_path / "run", NOVEL, "records/novel.json", novel)
    check_written(tmp_path / "run", PRESETS, "records/presets.json", presets)
    check_written(tmp_path / "run", FAILURE, "failed.json", failed)
    assert read_failures(tmp_path) == [(tmp_path / "run", failed)]


@pytest.mark.parametrize("region", ["full", "human", "vehicle"])
def test_a_truth_has_three_regions_alone(region):
    assert NovelShift(offset=1.0, views=1, distances={}, truth={f"psnr_{region}": 1.0}, true_views=1)
    with pytest.raises(
        ValueError, match="truth holds psnr_near, psnr_sky, expected psnr_full, psnr_human, psnr_vehicle"
    ):
        NovelShift(offset=1.0, views=1, distances={}, truth={"psnr_sky": 1.0, "psnr_near": 2.0}, true_views=1)


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
