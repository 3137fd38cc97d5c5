"""Time to quality from curves of known shape."""

import pytest

from sparsestreet.records.held_out import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.records.strict_json import RecordError
from sparsestreet.report import collect
from sparsestreet.report.arms import arms
from sparsestreet.report.curves import QualityCurve, curves_of, mean_curve, seconds_to, time_to_quality
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record, write_sweep


def test_the_first_look_that_is_good_enough():
    curve = QualityCurve((10.0, 20.0, 30.0), (20.0, 22.0, 21.5))
    assert seconds_to(curve, 21.5) == 20.0  # nothing between two looks
    assert seconds_to(curve, 22.1) is None


def test_the_mean_is_over_looks_that_all_curves_have():
    curves = [QualityCurve((10.0, 20.0), (20.0, 22.0)), QualityCurve((12.0, 24.0, 36.0), (21.0, 24.0, 25.0))]
    assert mean_curve(curves) == QualityCurve((11.0, 22.0), (20.5, 23.0))


def test_runs_of_one_scene_and_seed_are_their_mean(tmp_path):
    """Runs that were trained on all views are in no mean with them."""
    runs = []
    for name, seconds, psnr, split in (("a", 10.0, 20.0, "some"), ("b", 12.0, 21.0, "some"), ("c", 99.0, 9.0, "none")):
        HELD_OUT_CURVE.write(tmp_path / name, [HeldOutLook(seconds, 9, psnr, None, None)])
        runs.append(record(make_summary("plain", split=split, training_psnr=20.0), str(tmp_path / name)))
    (arm,) = arms(runs)
    assert list(curves_of(arm).values()) == [QualityCurve((11.0,), (20.5,))]


def test_seconds_to_the_plain_runs_quality(tmp_path):
    """Curves end at -3, -0.8, -0.3 and 0 dB; removal ends 0.2, 0.3 and 0.4 dB lower, the control 2 dB."""
    grid = time_to_quality(arms(collect([write_sweep(tmp_path)])))
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in grid.rows}
    assert rows["streetgs"] == ["20.0 s", "30.0 s", "40.0 s"]
    # Within 1 dB: at -0.8 - 0.2 (20 s), else 30 s. Within 0.5: -0.3 - 0.2 at 30 s, else 40 s.
    assert rows["streetgs+removal"] == ["30.0 s", "40.0 s", "not reached"]
    assert rows["control: streetgs+random"] == ["not reached"] * 3


def test_the_last_look_of_the_plain_run_counts_not_its_best(tmp_path):
    """It ends 1 dB below its best: 0.5 dB below its end are 18.5 dB, which it has at 10 s."""
    looks = enumerate((18.6, 20.0, 19.0), start=1)
    HELD_OUT_CURVE.write(tmp_path, [HeldOutLook(10.0 * step, step, psnr, None, None) for step, psnr in looks])
    grid = time_to_quality(arms([record(make_summary("plain"), str(tmp_path))]))
    assert [cell.text for cell in grid.rows[0][1:]] == ["10.0 s", "10.0 s", "20.0 s"]


def test_no_curve_no_table(tmp_path):
    assert time_to_quality(arms(collect([write_sweep(tmp_path, curves=False)]))) is None


def test_a_malformed_curve_is_named(tmp_path):
    run = write_sweep(tmp_path) / "streetgs_seed0"
    path = HELD_OUT_CURVE.path(run)
    path.write_text(path.read_text() + "soon,5,20.0,,\n")
    with pytest.raises(RecordError, match=r"held_out\.csv, line 6: could not convert .*soon.*; train the run again"):
        time_to_quality(arms(collect([tmp_path])))
