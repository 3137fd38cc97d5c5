"""Numbers beside the recorded path."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from sparsestreet.metrics.definitions import DRIVESTUDIO, STRICT
from sparsestreet.records.renders import NOVEL, PRESETS, PresetRecord, RenderedAs
from sparsestreet.records.strict_json import RecordError
from sparsestreet.report.collect import collect
from sparsestreet.report.frame import shifts_of
from sparsestreet.report.novel_views import TRUTH, beside_the_path, rendered_otherwise
from sparsestreet.report.paper import paper_table
from sparsestreet.report.variants import variants
from tests.evaluation.frames import NOISE, make_summary
from tests.records.novel import write_beside
from tests.report.sweep_folder import record, write_sweep


def test_both_sides_count_alike(tmp_path):
    write_beside(tmp_path, {1.0: 40.0, -1.0: 44.0, 2.0: 60.0}, psnr=20.0)
    true = TRUTH["psnr_full"]
    assert shifts_of(tmp_path) == {1.0: {"fid": 42.0, true: 20.0}, 2.0: {"fid": 60.0, true: 20.0}}


def test_an_arm_is_the_mean_of_its_scenes(tmp_path):
    sweep = write_sweep(tmp_path)
    for seed in range(3):
        write_beside(sweep / f"streetgs_seed{seed}", {1.0: 40.0 + seed, -1.0: 40.0 + seed})
    grid = beside_the_path(variants(collect([sweep])))
    assert grid.header == (("", "arm"), ("fid", "1 m"))
    assert [row[1].text for row in grid.rows] == ["41", "-", "-"]


@pytest.mark.parametrize("seeds", [(0, 1), (0, 0)])
def test_a_scene_is_the_mean_of_its_runs(tmp_path, seeds):
    """Of other seeds and of one and the same."""
    runs = []
    for seed, distance in zip(seeds, (41.25, 43.25), strict=True):
        folder = tmp_path / str(distance)
        write_beside(folder, {1.0: distance, -1.0: distance})
        runs.append(record(make_summary("plain", seed), str(folder)))
    assert [row[1].text for row in beside_the_path(variants(runs)).rows] == ["42.25"]


@pytest.mark.parametrize(("splits", "distance"), [(("some", "none"), "41"), (("none", "none"), "42")])
def test_runs_on_all_views_are_in_no_mean_with_the_others(tmp_path, splits, distance):
    """Their real images are those that they trained on."""
    runs = []
    for split, value in zip(splits, (41.0, 43.0), strict=True):
        folder = tmp_path / str(value)
        write_beside(folder, {1.0: value, -1.0: value})
        runs.append(record(make_summary("plain", split=split, training_psnr=20.0), str(folder)))
    assert [row[1].text for row in beside_the_path(variants(runs)).rows] == [distance]


def test_the_truth_comes_before_distances(tmp_path):
    sweep = write_sweep(tmp_path)
    write_beside(sweep / "streetgs_seed0", {1.0: 41.25, -1.0: 41.25, 2.0: 50.0}, name="a_distance", psnr=20.4)
    grid = beside_the_path(variants(collect([sweep])))
    names = [TRUTH["psnr_full"]] * 2 + ["a_distance"] * 2
    assert grid.header[1:] == tuple(zip(names, ["1 m", "2 m"] * 2, strict=True))
    assert [cell.text for cell in grid.rows[0][1:]] == ["20.40", "20.40", "41.25", "50"]


def test_table_4_holds_the_inception_distance_alone(tmp_path):
    summary = make_summary("omnire", scene="023")
    object.__setattr__(summary.run, "method", "omnire")
    write_beside(tmp_path, {1.0: 40.0, -1.0: 44.0})
    (variant,) = variants([record(summary, str(tmp_path))])
    grid = paper_table([variant], [], DRIVESTUDIO, "table4_novel")
    assert [cell.text for cell in grid.rows[0]] == ["omnire", "1", "42.00", "43.62", "-", "61.56", "-", "75.14"]
    write_beside(tmp_path, {1.0: 40.0, -1.0: 44.0}, name="frechet_alexnet")
    again = variants([record(summary, str(tmp_path))])
    assert paper_table(again, [], DRIVESTUDIO, "table4_novel").rows[0][2].text == "-"


def test_none_recorded_no_table(tmp_path):
    assert beside_the_path(variants(collect([write_sweep(tmp_path)]))) is None


def test_what_a_record_lacks_is_named(tmp_path):
    write_beside(tmp_path, {1.0: 40.0}, psnr=20.0)
    path = NOVEL.path(tmp_path)
    entries = json.loads(path.read_text())
    (shift,) = entries["shifts"]
    path.write_text(json.dumps(entries | {"shifts": [shift | {"truth": {"psnr_sky": 20.0}}]}))
    with pytest.raises(RecordError, match=r"novel\.json: shifts\[0\]: truth holds psnr_sky, expected psnr_full, "):
        shifts_of(tmp_path)
    del shift["truth"]
    path.write_text(json.dumps(entries | {"shifts": [shift]}))
    with pytest.raises(RecordError, match=r"novel\.json: shifts\[0\]: NovelShift lacks the keys \['truth'\]"):
        shifts_of(tmp_path)
    path.write_text(json.dumps(entries | {"format": 1}))
    with pytest.raises(RecordError, match=r"format 1, this version reads 2: evaluate again with novel"):
        shifts_of(tmp_path)


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
    found = variants(collect([sweep]))
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
    (plain, *_) = variants(collect([sweep]))
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
    default, fast = rendered_otherwise(variants(runs), DRIVESTUDIO).rows
    assert [cell.text for cell in fast[2:5]] == expected
    assert default[1].text == "default, as trained"


def test_none_recorded_no_table_presets(tmp_path):
    assert rendered_otherwise(variants(collect([write_sweep(tmp_path)])), DRIVESTUDIO) is None


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
    grid = rendered_otherwise(variants(runs), protocol)
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
    grid = rendered_otherwise(variants([record(make_summary("m"), str(tmp_path))]), DRIVESTUDIO)
    assert grid.notes[-1] == "§ times of a machine that was not quiet, compared with no other: m"
    assert [row[-1].text for row in grid.rows] == ["20.00 §", "12.00 §"]
