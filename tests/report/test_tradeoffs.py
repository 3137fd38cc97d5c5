"""Differences and best arms against numbers worked out by hand."""

import pytest

from sparsestreet.metrics.protocols import DRIVESTUDIO
from sparsestreet.report.arms import arms
from sparsestreet.report.tradeoffs import differences, matched_budget, matched_quality, paired
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record, street_runs


@pytest.fixture(scope="module")
def found():
    return arms([record(run, name) for name, run in street_runs().items()])


def by_heading(grid, row):
    return {heading: cell for (_, heading), cell in zip(grid.header, row, strict=True)}


def test_pairs_are_of_a_scene_and_a_seed(found):
    plain, removal, _ = found
    loss = paired(removal, plain, lambda run: run.mean("psnr_full"))
    # -0.2, -0.3, -0.4: t(2) = 4.303, sd 0.1
    assert loss.mean == pytest.approx(-0.3)
    assert loss.high - loss.mean == pytest.approx(4.303 * 0.1 / 3**0.5, abs=1e-3)


def test_seeds_of_one_scene_are_the_pairs_else_scenes_are():
    runs = {
        ("plain", "a", 0): 20.0, ("plain", "a", 1): 21.0, ("plain", "b", 0): 30.0,
        ("plain+removal", "a", 0): 19.0, ("plain+removal", "a", 1): 19.0, ("plain+removal", "b", 0): 29.0,
    }  # fmt: skip
    records = [record(make_summary(label, seed, value, scene=scene)) for (label, scene, seed), value in runs.items()]
    plain, removal = arms(records)
    both = paired(removal, plain, lambda run: run.mean("psnr_full"))
    assert (both.mean, both.n) == (pytest.approx(-1.25), 2)  # scene a: -1.5, scene b: -1
    plain, removal = arms([one for one in records if one.summary.run.scene == "a"])
    alone = paired(removal, plain, lambda run: run.mean("psnr_full"))
    assert (alone.mean, alone.n) == (pytest.approx(-1.5), 2)


def test_bold_where_the_interval_excludes_zero(found):
    grid = differences(found, DRIVESTUDIO)
    removal, control = (by_heading(grid, row) for row in grid.rows)
    assert removal["arm - plain"].text == "streetgs+removal - streetgs"
    assert control["arm - plain"].text == "control: streetgs+random - streetgs"
    assert (removal["n"].text, removal["PSNR full"].text) == ("3", "-0.30 [-0.55, -0.05]")
    assert removal["PSNR full"].bold
    assert not removal["PSNR vehicle"].bold  # all alike: 0 [0, 0]
    assert removal["ms/frame, %"].text.startswith("-75.0")


def test_one_pair_is_never_bold():
    runs = [make_summary("plain", 0, 25.0), make_summary("plain+removal", 0, 20.0)]
    grid = differences(arms([record(run) for run in runs]), DRIVESTUDIO)
    cell = by_heading(grid, grid.rows[0])
    assert (cell["PSNR full"].text, cell["PSNR full"].bold, cell["n"].text) == ("-5.00", False, "1")


def test_an_arm_without_its_plain_run_is_named():
    grid = differences(arms([record(make_summary("plain+removal"))]), DRIVESTUDIO)
    assert not grid.rows
    assert "to compare with: plain+removal" in grid.notes[-1]


def test_the_smallest_arm_of_a_quality(found):
    chosen = {row[0].text: by_heading(grid, row) for grid in [matched_quality(found, DRIVESTUDIO)] for row in grid.rows}
    assert chosen["streetgs, at most 0.1 dB"]["arm"].text == "streetgs"
    assert chosen["streetgs, at most 0.5 dB"]["arm"].text == "streetgs+removal"
    assert chosen["streetgs, at most 0.5 dB"]["Gaussians"].text == "2,510"


def test_the_best_arm_of_a_budget(found):
    grid = matched_budget(found, DRIVESTUDIO)
    chosen = {row[0].text: by_heading(grid, row) for row in grid.rows}
    assert chosen["streetgs, at most 25 % of its Gaussians"]["arm"].text == "none of this sweep"  # 25.1 %
    half = chosen["streetgs, at most 50 % of its Gaussians"]
    assert (half["arm"].text, half["PSNR full, dB"].text, half["share, %"].text) == ("streetgs+removal", "-0.30", "25")
    assert half["train minutes"].text == "1.67"  # 100 seconds


def test_a_larger_arm_within_the_budget_is_better():
    """Of two arms below half of the Gaussians the one that loses less, not the smaller one."""
    counts = {"plain": (25.0, 1000), "plain+small": (23.0, 100), "plain+larger": (24.5, 400)}
    runs = [make_summary(label, 0, psnr, {"background": rows}) for label, (psnr, rows) in counts.items()]
    grid = matched_budget(arms([record(run) for run in runs]), DRIVESTUDIO)
    chosen = {row[0].text: by_heading(grid, row)["arm"].text for row in grid.rows}
    assert chosen["plain, at most 25 % of its Gaussians"] == "plain+small"
    assert chosen["plain, at most 50 % of its Gaussians"] == "plain+larger"


def test_a_gain_is_no_loss():
    """An arm that is smaller and better by 0.6 dB is within every limit."""
    runs = [make_summary("plain", 0, 25.0), make_summary("plain+removal", 0, 25.6, {"background": 300})]
    grid = matched_quality(arms([record(run) for run in runs]), DRIVESTUDIO)
    chosen = [by_heading(grid, row) for row in grid.rows]
    assert [(row["arm"].text, row["PSNR full, dB"].text) for row in chosen] == [("plain+removal", "+0.60")] * 3
