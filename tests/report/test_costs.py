"""What each arm costs, in absolute numbers."""

from sparsestreet.report import collect
from sparsestreet.report.arms import arms
from sparsestreet.report.costs import what_arms_cost
from tests.report.sweep_folder import write_sweep


def test_means_over_the_runs_of_an_arm(tmp_path):
    """Forward is all of a step that is neither backward nor the optimizer: 1 + 2 + 0.5 + 0.25 + 0.125 ms."""
    grid = what_arms_cost(arms(collect([write_sweep(tmp_path)])))
    names = [" ".join(heading).strip() for heading in grid.header]
    removal = dict(zip(names, (cell.text for cell in grid.rows[1]), strict=True))
    assert (removal["arm"], removal["n"], removal["Gaussians"]) == ("streetgs+removal", "3", "2,510")
    assert (removal["ms/frame"], removal["train s"], removal["seconds pruning"]) == ("10.00", "100.0", "0.2")
    steps = [removal[f"ms of a step {part}"] for part in ("forward", "backward", "optimizer")]
    assert steps == ["3.9", "4.0", "0.5"]
    assert "peak MB host" not in removal  # no run recorded it


def test_without_cost_records_the_summary_is_left(tmp_path):
    grid = what_arms_cost(arms(collect([write_sweep(tmp_path, curves=False)])))
    assert [heading for _, heading in grid.header] == ["arm", "n", "Gaussians", "MB", "ms/frame", "train s"]
