"""The cost of each arm in absolute numbers (``records/summary.json`` and ``records/cost.json``)."""

import statistics
from collections.abc import Callable, Sequence

from sparsestreet.records.costs import COSTS, PRUNE, CostRecord
from sparsestreet.report.arms import Arm, busy_arms
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.grid import Cell, Grid, number_cell

_CLOCK_OF = {"ms/frame": "frames", "train s": "training"} | dict.fromkeys(("seconds", "ms of a step"), "training")
"""Heading, or shared heading, of a column of times -> what its machine was measured with."""

_COLUMNS: tuple[tuple[str, str, str, Callable[[RunRecord], float | None]], ...] = (
    ("", "Gaussians", "{:,.0f}", lambda record: float(record.summary.gaussians_total)),
    ("", "MB", "{:.2f}", lambda record: record.summary.bytes_total / 1e6),
    ("", "ms/frame", "{:.2f}", lambda record: record.summary.latency.p50),
    ("", "train s", "{:.1f}", lambda record: record.summary.run.training_seconds),
    ("seconds", "pruning", "{:.1f}", lambda record: _of(record, lambda costs: costs.phases.get(PRUNE, 0.0))),
    ("seconds", "whole command", "{:.0f}", lambda record: _of(record, lambda costs: costs.wall_seconds)),
    ("ms of a step", "forward", "{:.1f}", lambda record: _of(record, lambda costs: _step(costs, *_forward(costs)))),
    ("ms of a step", "backward", "{:.1f}", lambda record: _of(record, lambda costs: _step(costs, "backward"))),
    ("ms of a step", "optimizer", "{:.1f}", lambda record: _of(record, lambda costs: _step(costs, "optimizer"))),
    ("peak MB", "host", "{:.0f}", lambda record: _of(record, lambda costs: costs.peak_host_mb)),
    ("peak MB", "GPU", "{:.0f}", lambda record: _of(record, lambda costs: costs.peak_device_mb)),
)


def what_arms_cost(arms: Sequence[Arm]) -> Grid:
    """Returns size, speed, time and memory of every arm, as means over its runs."""
    shown = [column for column in _COLUMNS if any(_mean(arm, column[3]) is not None for arm in arms)]
    rows = []
    for arm in arms:
        runs = tuple(record.folder.name for record in arm.records)
        clocks = [_CLOCK_OF.get(group or heading) for group, heading, _, _ in shown]
        marks = [arm.busy(clock) if clock else "" for clock in clocks]
        cells = [
            number_cell(_mean(arm, value), form, runs, mark)
            for (_, _, form, value), mark in zip(shown, marks, strict=True)
        ]
        rows.append((Cell(arm.title, runs=runs), Cell(str(len(runs)), runs=runs), *cells))
    header = (("", "arm"), ("", "n"), *((group, heading) for group, heading, _, _ in shown))
    notes = [
        "means over the runs of an arm; train s: steps and pruning, without evaluation; whole command: from the import "
        "of torch to the pictures; a step: medians over the steps that records/phases.csv notes"
    ]
    return Grid("costs", "What each arm costs", header, tuple(rows), (*notes, *busy_arms(arms)))


def _of(record: RunRecord, value: Callable[[CostRecord], float | None]) -> float | None:
    costs = COSTS.find(record.folder)
    return None if costs is None else value(costs)


def _forward(costs: CostRecord) -> tuple[str, ...]:
    """Returns the parts of a step's forward pass; effects have their own names."""
    return ("scene", "splat", *costs.effects, "losses", "regularizers")


def _step(costs: CostRecord, *parts: str) -> float | None:
    found = [costs.step_ms[part] for part in parts if part in costs.step_ms]
    return sum(found) if found else None


def _mean(arm: Arm, value: Callable[[RunRecord], float | None]) -> float | None:
    found = [number for record in arm.records if (number := value(record)) is not None]
    return statistics.fmean(found) if found else None
