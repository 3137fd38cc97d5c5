"""What figures draw, and that their ink is the page's."""

import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from sparsestreet.metrics.protocols import DRIVESTUDIO
from sparsestreet.records.costs import NodeCost, update_costs
from sparsestreet.records.held_out import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.records.ledger import LEDGER, PRUNING, CountChange
from sparsestreet.records.strict_json import RecordError
from sparsestreet.report import collect, figures_time
from sparsestreet.report.arms import arms
from sparsestreet.report.figures import GREY, PARETO_COSTS, front, pareto, short
from sparsestreet.report.figures_time import (
    _counts,
    _frame_costs,
    counts_over_time,
    frame_waterfall,
    held_out_over_time,
)
from sparsestreet.report.sweep import _figures
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record, write_sweep


def test_the_front_is_what_nothing_beats():
    points = [(1.0, 20.0), (2.0, 19.0), (2.0, 22.0), (3.0, 22.0), (4.0, 23.0)]
    assert front(points) == [(1.0, 20.0), (2.0, 22.0), (4.0, 23.0)]


def test_short_numbers():
    assert [short(value) for value in (0.5, 200.0, 12_000.0, 1.5e6)] == ["0.5", "200", "12k", "1.5M"]


@pytest.fixture
def found(tmp_path):
    return arms(collect([write_sweep(tmp_path / "sweep", failed=False)]))


@pytest.mark.lengthy
def test_pareto_draws_every_run_and_every_mean(found, tmp_path):
    path = tmp_path / "pareto.svg"
    assert pareto(found, DRIVESTUDIO, PARETO_COSTS[0], path)
    text = path.read_text()
    titles = [name for name in ("full image", "people", "vehicles") if f">{name}<" in text]
    assert titles == ["full image", "vehicles"]  # no run measured people
    # 3 runs and a mean, of 2 plain or pruned arms and a grey one, in 2 panels; and one in the legend.
    assert len(re.findall(r"<use [^>]*fill: #1f86c9", text)) == 2 * 2 * 4 + 1
    assert len(re.findall(rf"<use [^>]*stroke: {GREY}", text)) >= 2 * 4
    assert "control: random" in text


@pytest.mark.lengthy
def test_ink_is_the_pages_and_names_are_not_shared(found, tmp_path):
    first, second = tmp_path / "a.svg", tmp_path / "b.svg"
    pareto(found, DRIVESTUDIO, PARETO_COSTS[0], first)
    pareto(found, DRIVESTUDIO, PARETO_COSTS[1], second)
    one, other = first.read_text(), second.read_text()
    assert "currentColor" in one
    assert "#010203" not in one
    ids = [set(re.findall(r'id="([^"]+)"', text)) for text in (one, other)]
    assert not ids[0] & ids[1]
    assert set(re.findall(r"#([a-z0-9]+)[\")]", one.replace("&quot;", '"'))) <= ids[0] | {"8c8c8c", "1f86c9"}
    pareto(found, DRIVESTUDIO, PARETO_COSTS[0], tmp_path / "again" / "a.svg")
    assert (tmp_path / "again" / "a.svg").read_text() == one


@pytest.mark.lengthy
def test_figures_over_time(found, tmp_path):
    for draw, word in ((held_out_over_time, "training seconds"), (counts_over_time, "step"), (frame_waterfall, "sky")):
        assert draw(found, tmp_path / "some.svg")
        assert word in (tmp_path / "some.svg").read_text()


def test_a_bar_is_the_mean_over_runs(tmp_path):
    runs = []
    for seed, ms in enumerate((1.0, 4.0)):
        update_costs(tmp_path / str(seed), nodes={"rigid": NodeCost(10, 0.1, 4.0, ms)}, effects={"sky": 2 * ms})
        runs.append(record(make_summary("plain", seed), str(tmp_path / str(seed))))
    (arm,) = arms(runs)
    assert _frame_costs(arm) == {"rigid": 2.5, "effect: sky": 5.0}


def test_counts_are_of_all_nodes(tmp_path):
    """100 and 20 Gaussians, of which pruning leaves 30 and 20."""
    starts = [CountChange(0, name, 0, rows, "start") for name, rows in (("background", 100), ("rigid", 20))]
    LEDGER.write(tmp_path, [*starts, CountChange(5, "background", 100, 30, PRUNING)])
    axes = Figure().subplots()
    (arm,) = arms([record(make_summary("plain"))])
    _counts(axes, arm, tmp_path)
    line, dots = ([np.asarray(values).tolist() for values in drawn.get_data()] for drawn in axes.get_lines())
    assert (line, dots) == ([[0, 5], [120, 50]], [[5], [50]])


def test_a_figure_of_an_earlier_report_goes(tmp_path):
    """Where the records no longer hold what it shows."""
    for name in ("pareto_frame", "held_out", "counts", "waterfall", "of_somebody_else"):
        (tmp_path / f"{name}.svg").write_text("<svg/>")
    assert _figures([], DRIVESTUDIO, tmp_path)[0] == []
    assert [path.name for path in tmp_path.iterdir()] == ["of_somebody_else.svg"]


def test_every_run_has_a_line(tmp_path, monkeypatch):
    """Two of one scene and seed have two."""
    runs = []
    for name in "ab":
        HELD_OUT_CURVE.write(tmp_path / name, [HeldOutLook(10.0, 9, 20.0, None, None)])
        runs.append(record(make_summary("plain"), str(tmp_path / name)))
    drawn = []
    monkeypatch.setattr(figures_time, "write_svg", lambda figure, path: drawn.append(figure))
    assert held_out_over_time(arms(runs), tmp_path / "some.svg")
    assert len(drawn[0].axes[0].get_lines()) == 2


def test_what_was_not_recorded_is_not_drawn(tmp_path):
    found = arms(collect([write_sweep(tmp_path / "sweep", curves=False)]))
    for draw in (held_out_over_time, frame_waterfall):
        assert not draw(found, tmp_path / "some.svg")
    assert not (tmp_path / "some.svg").exists()


def test_costs_of_another_format_are_named(found, tmp_path):
    path = found[0].records[0].folder / "records" / "cost.json"
    path.write_text("{}")
    with pytest.raises(RecordError, match=r"cost\.json: .*has format None"):
        frame_waterfall(found, tmp_path / "some.svg")
