"""What each arm costs, in absolute numbers."""

from dataclasses import replace
from typing import Any

from sparsestreet.records.costs import update_costs
from sparsestreet.report import RunRecord, collect
from sparsestreet.report.arms import arms
from sparsestreet.report.costs import what_arms_cost
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record, write_sweep


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


def test_every_column_has_a_number_of_its_own(tmp_path):
    """Means of two runs; what is neither forward, backward nor the optimizer is in no column."""
    runs = []
    for seed in (0, 1):
        folder = tmp_path / f"run{seed}"
        gaussians = {"background": 1000, "rigid": 500 + 1000 * seed}
        numbers: dict[str, Any] = {"milliseconds": 7.0 + seed, "training_seconds": 50.0 + 4 * seed}
        runs.append(RunRecord(folder, make_summary("m", seed, gaussians=gaussians, **numbers)))
        parts = {"scene": 1.0, "splat": 2.0, "lens": 4.0, "losses": 8.0, "regularizers": 16.0, "loop": 500.0}
        parts |= {"backward": 32.0, "optimizer": 64.0, "density": 250.0, "sky": 125.0}  # no effect of this scene
        update_costs(
            folder,
            wall_seconds=300.0 + 100 * seed,
            phases={"train": 297.5 + 100 * seed, "prune": 2.5},
            step_ms={name: value + seed for name, value in parts.items()},
            effects={"lens": 0.5},
            peak_host_mb=800.0 + 50 * seed,
            peak_device_mb=6000.0 + 500 * seed,
        )
    grid = what_arms_cost(arms(runs))
    (row,) = grid.rows
    assert grid.header == (
        *(("", "arm"), ("", "n"), ("", "Gaussians"), ("", "MB"), ("", "ms/frame"), ("", "train s")),
        *(("seconds", "pruning"), ("seconds", "whole command")),
        *(("ms of a step", part) for part in ("forward", "backward", "optimizer")),
        *(("peak MB", "host"), ("peak MB", "GPU")),
    )
    # 1,500 and 2,500 Gaussians of 59 float32; forward: 31 ms of five parts, and 31 + 5.
    assert [cell.text for cell in row] == [
        *("m", "2", "2,000", "0.47", "7.50", "52.0", "2.5", "350", "33.5", "32.5", "64.5", "825", "6250"),
    ]
    assert {cell.runs for cell in row} == {("run0", "run1")}
    assert len(grid.notes) == 1


def test_a_run_without_pruning_has_spent_no_seconds_on_it(tmp_path):
    update_costs(tmp_path, phases={"train": 9.0})
    grid = what_arms_cost(arms([RunRecord(tmp_path, make_summary("m"))]))
    assert dict(zip(grid.header, (cell.text for cell in grid.rows[0]), strict=True))["seconds", "pruning"] == "0.0"


def test_a_machine_that_was_not_quiet_is_named():
    calm, loud = make_summary("m"), make_summary("m", 1)
    latency = replace(loud.latency, noise=replace(loud.latency.noise, quiet=False))
    runs = [record(calm), record(replace(loud, latency=latency))]
    grid = what_arms_cost(arms(runs))
    assert grid.notes[-1].startswith("§ times of a machine that was not quiet, compared with no other: frames of m")
    assert [cell.text for cell in grid.rows[0]][-2:] == ["40.00 §", "100.0"]
