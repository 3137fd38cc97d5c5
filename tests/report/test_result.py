"""The last lines of a command against numbers that the record was given."""

import dataclasses
from pathlib import Path

import pytest

from sparsestreet.records.costs import EffectGain, update_costs
from sparsestreet.records.curves import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.records.geometry import RangeErrors
from sparsestreet.records.run import EffectDecision
from sparsestreet.records.summary import HELD_OUT, MetricSummary
from sparsestreet.report.result import result_lines
from tests.evaluation.frames import disturbed, make_summary, with_ranges
from tests.typed import there


def test_what_a_run_came_to():
    summary = make_summary("plain", 0, 24.35, {"background": 15_000, "rigid": 613}, training_psnr=26.0)
    people = {"psnr_human": MetricSummary(19.8, None, 3, 0), "ssim_uniform7_full": MetricSummary(0.8124, None, 6, 0)}
    summary = dataclasses.replace(summary, quality=summary.quality | {HELD_OUT: summary.quality[HELD_OUT] | people})
    held_out, training, size, places = result_lines(summary, Path("outputs/a"))
    assert held_out == "held-out views: PSNR 24.35 dB, vehicles 22.00 dB, people 19.80 dB, SSIM 0.812"
    assert training == "training views: PSNR 26.00 dB, vehicles 22.00 dB, SSIM 0.800"
    # 59 float32 a Gaussian, and 100 seconds of training, says make_summary.
    assert size.startswith("15,613 Gaussians, 3.68 MB, 100 s of training, 40.0 ms a frame")
    assert places == "pictures: outputs/a/pictures/sheet.png; curves: outputs/a/curves; numbers: outputs/a/records"


def test_ranges_are_said_where_lidar_measured_them():
    vehicles = RangeErrors(90, 90, 0.0931, 0.2, 0.646, 0.1)
    lines = result_lines(with_ranges(make_summary("plain"), 0.1304, 0.654, vehicles=vehicles), Path("a"))
    assert lines[1] == (
        "ranges along the rays of 2 held-out sweeps: median error in images 0.130 m (65 % within 0.2 m), "
        "on vehicles 0.093 m (65 % within 0.2 m)"
    )
    seen = with_ranges(make_summary("plain"), 0.1304, 0.654)
    learned = dataclasses.replace(there(seen.geometry), intensity_error=0.0811, intensity_spread=0.0959)
    lines = result_lines(dataclasses.replace(seen, geometry=learned), Path("a"))
    assert lines[1].endswith("0.130 m (65 % within 0.2 m), intensities 0.081 off (0.096 if all were the same)")
    none = result_lines(with_ranges(make_summary("plain"), None, 0.0), Path("a"))
    assert not any("ranges" in line for line in none)


@pytest.mark.parametrize(("psnr", "training"), [(None, 26.0), (25.0, None)])
def test_only_what_was_measured_is_said(psnr, training):
    lines = result_lines(make_summary("plain", 0, psnr, training_psnr=training), Path("a"))
    assert len(lines) == 3
    assert lines[0].startswith("training views: PSNR 26.00" if psnr is None else "held-out views: PSNR 25.00")
    assert "people" not in lines[0]


def test_what_held_out_views_have_lost_is_said(tmp_path):
    """More than half a decibel; a column without numbers says nothing."""
    (tmp_path / "curves").mkdir()
    looks = [(20_000, 32.0, 30.7, None), (25_000, 32.4, 25.0, None), (30_000, 31.95, 21.9, None)]
    HELD_OUT_CURVE.write(tmp_path, [HeldOutLook(9.0, step, full, people, cars) for step, full, cars, people in looks])
    (said,) = result_lines(make_summary("plain", 0, 24.35), tmp_path)[-2:-1]
    assert said == (
        "held-out views were better before (curves/held_out.png): vehicles 30.70 dB at step 20,000, 21.90 dB at the end"
    )
    HELD_OUT_CURVE.write(tmp_path, [HeldOutLook(9.0, 1, 33.0, None, None), HeldOutLook(9.0, 2, 32.4, None, None)])
    assert "PSNR 33.00 dB at step 1, 32.40 dB at the end" in result_lines(make_summary("plain", 0, 24.35), tmp_path)[-2]
    HELD_OUT_CURVE.write(tmp_path, [HeldOutLook(9.0, 1, 32.8, None, None), HeldOutLook(9.0, 2, 32.4, None, None)])
    assert not any("better before" in line for line in result_lines(make_summary("plain", 0, 24.35), tmp_path))


def test_what_effects_bring_is_said_beside_what_was_foreseen(tmp_path):
    def decided(name: str, on: bool, gain: float | None) -> EffectDecision:
        said = {"source": "measured", "reason": "seen", "unit": "EV", "numbers": 3, "ms": 0.1, "gain": gain}
        return EffectDecision(name=name, on=on, value=1.0, threshold=0.5, noise=0.1, **said)

    effects = decided("sky", True, None), decided("exposure", True, 0.4), decided("lens", True, None)
    summary = make_summary("plain", 0, 24.35)
    run = dataclasses.replace(summary.run, effects=(*effects, decided("affine", False, 0.2)))
    summary = dataclasses.replace(summary, run=run)
    assert len(result_lines(summary, tmp_path)) == 3  # nothing was measured
    gains = {"sky": 1.0, "exposure": 0.31, "lens": -0.07}
    update_costs(tmp_path, gains={name: EffectGain(gain, None, None, 6) for name, gain in gains.items()})
    brings, costs = result_lines(summary, tmp_path)[-3:-1]
    assert brings == "effects.exposure brings 0.31 dB (foreseen: 0.40)"
    assert costs == ("effects.lens costs more than it brings: -0.07 dB in 6 images; effects.lens=off trains without it")


def test_seconds_of_a_busy_machine_say_so():
    said = result_lines(disturbed(make_summary("plain", 0, 24.35), "training"), Path("a"))
    assert any(line.endswith("100 s of training (on a machine that was not quiet), 40.0 ms a frame") for line in said)


def test_what_was_held_back_and_what_rested_is_said_again():
    summary = make_summary("plain", 0, 24.35, {"background": 10})
    run = dataclasses.replace(summary.run, held_back={"background": 12_000}, rested={"background.means": 3})
    held_back, rested = result_lines(dataclasses.replace(summary, run=run), Path("a"))[-3:-1]
    assert held_back == "Gaussians that were not added because memory had no room: background 12,000"
    assert rested == (
        "rows that took no step because their gradient was not finite, counted at each step: background.means 3"
    )
