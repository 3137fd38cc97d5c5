"""Numbers beside the recorded path."""

import json

import pytest

from sparsestreet.metrics.definitions import DRIVESTUDIO
from sparsestreet.records.novel import NOVEL
from sparsestreet.records.strict_json import RecordError
from sparsestreet.report import collect
from sparsestreet.report.arms import arms
from sparsestreet.report.beside import TRUTH, beside_the_path, shifts_of
from sparsestreet.report.layouts import paper_table
from tests.evaluation.frames import make_summary
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
    grid = beside_the_path(arms(collect([sweep])))
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
    assert [row[1].text for row in beside_the_path(arms(runs)).rows] == ["42.25"]


@pytest.mark.parametrize(("splits", "distance"), [(("some", "none"), "41"), (("none", "none"), "42")])
def test_runs_on_all_views_are_in_no_mean_with_the_others(tmp_path, splits, distance):
    """Their real images are those that they trained on."""
    runs = []
    for split, value in zip(splits, (41.0, 43.0), strict=True):
        folder = tmp_path / str(value)
        write_beside(folder, {1.0: value, -1.0: value})
        runs.append(record(make_summary("plain", split=split, training_psnr=20.0), str(folder)))
    assert [row[1].text for row in beside_the_path(arms(runs)).rows] == [distance]


def test_the_truth_comes_before_distances(tmp_path):
    sweep = write_sweep(tmp_path)
    write_beside(sweep / "streetgs_seed0", {1.0: 41.25, -1.0: 41.25, 2.0: 50.0}, name="a_distance", psnr=20.4)
    grid = beside_the_path(arms(collect([sweep])))
    names = [TRUTH["psnr_full"]] * 2 + ["a_distance"] * 2
    assert grid.header[1:] == tuple(zip(names, ["1 m", "2 m"] * 2, strict=True))
    assert [cell.text for cell in grid.rows[0][1:]] == ["20.40", "20.40", "41.25", "50"]


def test_table_4_holds_the_inception_distance_alone(tmp_path):
    summary = make_summary("omnire", scene="023")
    object.__setattr__(summary.run, "method", "omnire")
    write_beside(tmp_path, {1.0: 40.0, -1.0: 44.0})
    (arm,) = arms([record(summary, str(tmp_path))])
    grid = paper_table([arm], [], DRIVESTUDIO, "table4_novel")
    assert [cell.text for cell in grid.rows[0]] == ["omnire", "1", "42.00", "43.62", "-", "61.56", "-", "75.14"]
    write_beside(tmp_path, {1.0: 40.0, -1.0: 44.0}, name="frechet_alexnet")
    assert paper_table([arm], [], DRIVESTUDIO, "table4_novel").rows[0][2].text == "-"


def test_none_recorded_no_table(tmp_path):
    assert beside_the_path(arms(collect([write_sweep(tmp_path)]))) is None


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
