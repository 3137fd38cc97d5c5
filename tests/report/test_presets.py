"""Trained one way, rendered another: rows, means over scenes, differences to the way that training rendered."""

from dataclasses import replace
from pathlib import Path

import pytest

from sparsestreet.metrics.definitions import DRIVESTUDIO, STRICT
from sparsestreet.records.presets import PRESETS, PresetRecord, RenderedAs
from sparsestreet.report import collect
from sparsestreet.report.arms import arms
from sparsestreet.report.presets import rendered_otherwise
from tests.evaluation.frames import NOISE, make_summary
from tests.report.sweep_folder import record, write_sweep


def write_rendered(run: Path, loss: float) -> None:
    """As it was trained (30 dB, 20 ms) and faster, for so many dB."""
    rendered = tuple(
        RenderedAs(
            preset=name,
            trained=not lost,
            quality={"psnr_full": 30.0 - lost},
            psnr_to_exact=50.0 - lost,
            frame_ms=milliseconds,
            repeats=12,
        )
        for name, lost, milliseconds in (("default", 0.0, 20.0), ("fast", loss, 12.0))
    )
    made = PresetRecord(command="c", device="cpu: x", threads=1, views=3, noise=NOISE, rendered=rendered)
    PRESETS.write(run, made)


def test_a_row_for_each_arm_and_preset(tmp_path):
    """Losses of 0.1, 0.2 and 0.3 dB: mean 0.2, half width of the t interval 4.3027 x 0.1 / sqrt(3) = 0.2484."""
    sweep = write_sweep(tmp_path)
    for seed in range(3):
        write_rendered(sweep / f"streetgs_seed{seed}", 0.1 * (seed + 1))
    found = arms(collect([sweep]))
    grid = rendered_otherwise(found, DRIVESTUDIO)
    texts = [[cell.text for cell in row] for row in grid.rows]
    assert texts == [
        ["streetgs", "default, as trained", "3", "30.00", "-", "-", "-", "-", "-", "50.0", "20.00"],
        ["streetgs", "fast", "3", "29.80", "-0.20 [-0.45, +0.05]", "-", "-", "-", "-", "49.8", "12.00"],
    ]
    assert not any("quiet" in note for note in grid.notes)
    assert rendered_otherwise(found, STRICT).rows[1][3].text == "-"  # its metric was not recorded


def test_arms_of_one_label_are_told_apart_by_how_they_were_trained(tmp_path):
    sweep = write_sweep(tmp_path, failed=False)
    for seed in range(3):
        write_rendered(sweep / f"streetgs_seed{seed}", 0.1)
    (plain, *_) = arms(collect([sweep]))
    other = replace(plain, name="streetgs render.settings.alpha_min=0.1")
    grid = rendered_otherwise([plain, other], DRIVESTUDIO)
    assert [row[0].text for row in grid.rows] == ["streetgs, default"] * 4


@pytest.mark.parametrize(
    ("splits", "expected"),
    [
        (("some", "some"), ["1", "29.80", "-0.20"]),  # losses of 0.1 and 0.3 dB, a pair alone
        (("some", "none"), ["1", "29.90", "-0.10"]),
        (("none", "none"), ["1", "29.80", "-0.20"]),
    ],
)
def test_runs_of_one_scene_and_seed_are_their_mean(tmp_path, splits, expected):
    """Those trained on all views count where no other has a record."""
    runs = []
    for name, loss, split in zip("ab", (0.1, 0.3), splits, strict=True):
        write_rendered(tmp_path / name, loss)
        runs.append(record(make_summary("plain", split=split, training_psnr=20.0), str(tmp_path / name)))
    default, fast = rendered_otherwise(arms(runs), DRIVESTUDIO).rows
    assert [cell.text for cell in fast[2:5]] == expected
    assert default[1].text == "default, as trained"


def test_none_recorded_no_table(tmp_path):
    assert rendered_otherwise(arms(collect([write_sweep(tmp_path)])), DRIVESTUDIO) is None


@pytest.mark.parametrize("protocol", [DRIVESTUDIO, STRICT])
def test_every_column_is_its_own(tmp_path, protocol):
    """Of two scenes: full, people and vehicles lose 0.1, 0.2 and 0.3 dB in the first, 0.2 dB more in the second."""
    names = (protocol.psnr, protocol.human[0], protocol.vehicle[0])
    runs = []
    for scene in (0, 1):
        ways = [
            RenderedAs(
                preset=preset,
                trained=preset == "fine",
                quality={name: 30.0 + place - lost * (0.1 * (place + 1) + 0.2 * scene)
                         for place, name in enumerate(names)} | {"psnr_sky": 1.0},
                psnr_to_exact=60.0 + scene - 10 * lost,
                frame_ms=20.0 + scene - 5 * lost,
                repeats=12,
            )
            for preset, lost in (("fast", 1.0), ("fine", 0.0))
        ]  # fmt: skip
        made = PresetRecord(command="c", device="d", threads=1, views=3, noise=NOISE, rendered=tuple(ways))
        folder = tmp_path / str(scene)
        PRESETS.write(folder, made)
        runs.append(record(make_summary("m", scene=f"s{scene}"), str(folder)))
    grid = rendered_otherwise(arms(runs), protocol)
    assert grid.header == (
        *(("", "trained"), ("", "rendered"), ("", "n")),
        *((f"PSNR {region}", what) for region in ("full", "human", "vehicle") for what in ("dB", "- as trained")),
        *(("", "dB to exact"), ("", "ms/frame")),
    )
    fast, fine = ([cell.text for cell in row] for row in grid.rows)
    # Two differences 0.2 apart: half width 12.706 x 0.1414 / sqrt(2) = 1.27.
    assert fast == [
        *("m", "fast", "2", "29.80", "-0.20 [-1.47, +1.07]", "30.70", "-0.30 [-1.57, +0.97]"),
        *("31.60", "-0.40 [-1.67, +0.87]", "50.5", "15.50"),
    ]
    assert fine == ["m", "fine, as trained", "2", "30.00", "-", "31.00", "-", "32.00", "-", "60.5", "20.50"]
    assert {cell.runs for row in grid.rows for cell in row if cell.text != "-"} == {("0", "1")}


def test_a_machine_that_was_not_quiet_is_named(tmp_path):
    write_rendered(tmp_path, 0.1)
    path = PRESETS.path(tmp_path)
    PRESETS.write(tmp_path, replace(PRESETS.read(tmp_path), noise=replace(NOISE, quiet=False)))
    assert path.is_file()
    grid = rendered_otherwise(arms([record(make_summary("m"), str(tmp_path))]), DRIVESTUDIO)
    assert grid.notes[-1] == "§ times of a machine that was not quiet, compared with no other: m"
    assert [row[-1].text for row in grid.rows] == ["20.00 §", "12.00 §"]
