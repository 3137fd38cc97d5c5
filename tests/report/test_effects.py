"""The table of effects: the plan of the runs beside what was measured."""

from dataclasses import replace

from sparsestreet.records.costs import EffectGain, update_costs
from sparsestreet.records.effects import EffectDecision
from sparsestreet.records.run import RunDescription
from sparsestreet.report import RunRecord
from sparsestreet.report.arms import arms
from sparsestreet.report.effects import what_effects_cost
from tests.evaluation.frames import make_summary

LENS = EffectDecision(
    name="lens", on=True, source="measured", reason="r", value=2.5, unit="px", threshold=0.5, noise=0.1,
    numbers=250_000, ms=0.75, gain=None,
)  # fmt: skip


def planned(seed: int, *effects: EffectDecision):
    summary = make_summary("m", seed)
    run: RunDescription = replace(summary.run, effects=effects)
    return replace(summary, run=run)


def test_predictions_stand_beside_measurements(tmp_path):
    sky = replace(LENS, name="sky", on=False, source="forced", value=None, threshold=None, numbers=0, gain=1.0)
    runs = []
    for seed in (0, 1):
        runs.append(RunRecord(tmp_path / str(seed), planned(seed, LENS, sky)))
        gains = {"lens": EffectGain(2.0 + seed, 1.0 if seed else None, None, 4)}
        update_costs(tmp_path / str(seed), effects={"lens": 0.5 + seed}, gains=gains)
    grid = what_effects_cost(arms(runs))
    assert [[cell.text for cell in row] for row in grid.rows] == [
        ["m", "lens", "on", "measured", "2.5 px", "0.5", "0.75", "1.00", "1", "-", "+2.50", "+1.00", "-"],
        ["m", "sky", "off", "forced", "-", "-", "0.75", "-", "0", "+1.00", "-", "-", "-"],
    ]


def test_repeats_may_decide_otherwise(tmp_path):
    runs = [RunRecord(tmp_path / str(seed), planned(seed, replace(LENS, on=bool(seed)))) for seed in (0, 1)]
    (row,) = what_effects_cost(arms(runs)).rows
    assert row[2].text == "on in 1 of 2"


def test_records_without_a_plan_give_no_row(tmp_path):
    assert what_effects_cost(arms([RunRecord(tmp_path, make_summary("m"))])).rows == ()
