"""What figures draw, and that their ink is the page's."""

import re
from dataclasses import replace
from typing import Any

import matplotlib.axes
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from sparsestreet.metrics.definitions import DRIVESTUDIO, STRICT
from sparsestreet.records.costs import NodeCost, update_costs
from sparsestreet.records.curves import HELD_OUT_CURVE, LEDGER, PRUNING, CountChange, HeldOutLook
from sparsestreet.report import figures
from sparsestreet.report.collect import collect
from sparsestreet.report.figures import (
    COLORS,
    GREY,
    PARETO_COSTS,
    _paint,
    counts_over_time,
    frame_waterfall,
    front,
    held_out_over_time,
    panels,
    pareto,
    styles,
    time_figure,
    write_svg,
)
from sparsestreet.report.sweep import _figures
from sparsestreet.report.variants import variants
from tests.evaluation.frames import disturbed, make_summary
from tests.report.sweep_folder import record, write_sweep


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12))
def test_the_front_is_what_nothing_beats(points):
    points = [(float(cost), float(quality)) for cost, quality in points]

    def beaten(point: tuple[float, float]) -> bool:
        return any(other[0] <= point[0] and other[1] >= point[1] and other != point for other in points)

    assert front(points) == sorted({point for point in points if not beaten(point)})


@pytest.fixture
def found(tmp_path):
    return variants(collect([write_sweep(tmp_path / "sweep", failed=False)]))


UNEQUAL = {
    ("plain", 0): (20.0, 1000), ("plain", 1): (22.0, 3000),
    ("plain+masks", 1): (21.5, 1500), ("plain+removal", 0): (19.0, 500), ("plain+removal", 1): (21.0, 700),
}  # fmt: skip
"""Label and seed -> PSNR and Gaussians; the masks lose 0.5 dB in the one seed that they have."""


@pytest.mark.lengthy
def test_an_arrow_is_of_the_seeds_that_both_arms_have(tmp_path, monkeypatch):
    """The mean of masks, 21.5, lies above that of the plain runs, 21, and they gain nothing: seed 0 is harder."""
    found = variants(
        [record(make_summary(name, seed, psnr, {"background": n})) for (name, seed), (psnr, n) in UNEQUAL.items()]
    )
    arrows, fronts, hollow = [], [], []
    axes = matplotlib.axes.Axes
    monkeypatch.setattr(axes, "annotate", lambda self, text, end, start, **_: arrows.append((start, end)))
    monkeypatch.setattr(axes, "plot", lambda self, x, y, **_: fronts.append(list(zip(x, y, strict=True))))
    scatter = axes.scatter

    def scattered(self, x, y, **style):
        hollow.extend([(x, y)] if style.get("facecolors") == "none" else [])
        return scatter(self, x, y, **style)

    monkeypatch.setattr(axes, "scatter", scattered)
    pareto(found, DRIVESTUDIO, PARETO_COSTS[0], tmp_path / "pareto.svg")
    assert arrows[:2] == [((3000.0, 22.0), (1500.0, 21.5)), ((2000.0, 21.0), (600.0, 20.0))]
    assert hollow[0] == (1500.0, 21.5)
    assert fronts[0] == [(600.0, 20.0), (2000.0, 21.0)]  # without the masks


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
    pareto(found, DRIVESTUDIO, PARETO_COSTS[0], tmp_path / "once" / "again" / "a.svg")
    assert (tmp_path / "once" / "again" / "a.svg").read_text() == one


def test_a_figure_of_an_earlier_report_goes(tmp_path):
    """Where the records no longer hold what it shows."""
    for name in ("pareto_frame", "held_out", "counts", "waterfall", "of_somebody_else"):
        (tmp_path / f"{name}.svg").write_text("<svg/>")
    assert _figures([], DRIVESTUDIO, tmp_path)[0] == []
    assert [path.name for path in tmp_path.iterdir()] == ["of_somebody_else.svg"]


@pytest.fixture
def canvas(monkeypatch):
    """The figures that would have been written, by the name of their file."""
    drawn = {}
    monkeypatch.setattr(figures, "write_svg", lambda figure, path, says=None: drawn.update({path.name: figure}))
    return drawn


def two_methods():
    """Of each a plain, a pruned and a control run; costs and qualities are all different."""
    runs = {
        "a": (20.0, 1000, 10.0, 600.0), "a+paper": (19.0, 100, 4.0, 720.0), "a+random": (15.0, 110, 5.0, 60.0),
        "b": (22.0, 9000, 20.0, 900.0), "b+removal": (18.0, 200, 6.0, 960.0),
    }  # fmt: skip
    found = []
    for label, (psnr, rows, ms, seconds) in runs.items():
        numbers: dict[str, Any] = {"vehicle_psnr": psnr - 7, "milliseconds": ms, "training_seconds": seconds}
        found.append(record(make_summary(label, 0, psnr, {"x": rows}, **numbers), label))
    return variants(found)


def points(collection):
    return [tuple(point) for point in np.asarray(collection.get_offsets()).tolist()]


def arrows(axes):
    return {(tuple(map(float, one.xyann)), tuple(map(float, one.xy))) for one in axes.texts}


@pytest.mark.parametrize(
    ("cost", "x"),
    [
        (PARETO_COSTS[0], (1000, 100, 110, 9000, 200)),
        (PARETO_COSTS[1], tuple(59 * 4e-6 * rows for rows in (1000, 100, 110, 9000, 200))),
        (PARETO_COSTS[2], (10.0, 4.0, 5.0, 20.0, 6.0)),
        (PARETO_COSTS[3], (10.0, 12.0, 1.0, 15.0, 16.0)),
    ],
    ids=[cost[0] for cost in PARETO_COSTS],
)
def test_a_panel_has_marks_arrows_and_the_front(canvas, tmp_path, cost, x):
    found = two_methods()
    assert [variant.name for variant in found] == ["a", "a+paper", "a+random", "b", "b+removal"]
    assert pareto(found, DRIVESTUDIO, cost, tmp_path / "p.svg")
    full, vehicles = canvas["p.svg"].axes
    assert [axes.get_title() for axes in (full, vehicles)] == ["full image", "vehicles"]
    assert {axes.get_xlabel() for axes in (full, vehicles)} == {cost[1]}
    assert [axes.get_ylabel() for axes in (full, vehicles)] == ["held-out PSNR, dB", ""]
    for axes, less in ((full, 0.0), (vehicles, 7.0)):
        y = [quality - less for quality in (20.0, 19.0, 15.0, 22.0, 18.0)]
        places = [pytest.approx(place) for place in zip(x, y, strict=True)]
        runs, means = axes.collections[::2], axes.collections[1::2]
        assert [points(one)[0] for one in runs] == places
        assert [points(one)[0] for one in means] == places
        assert {one.get_sizes().tolist()[0] for one in runs} == {9.0}
        assert {one.get_sizes().tolist()[0] for one in means} == {48.0}
        paint = [to_hex(one.get_facecolor()[0][:3]) for one in means]
        first, second = (color.lower() for color in COLORS[:2])
        assert paint == [first, first, GREY, second, second]
        # From plain to pruned, of no control.
        pairs = arrows(axes)
        assert pairs == {((x[0], y[0]), (x[1], y[1])), ((x[3], y[3]), (x[4], y[4]))}
        (line,) = axes.get_lines()
        drawn = list(zip(*(np.asarray(values).tolist() for values in line.get_data()), strict=True))
        kept = [place for index, place in enumerate(zip(x, y, strict=True)) if index != 2]
        assert drawn == [place for place in sorted(kept) if not any(beats(other, place) for other in kept)]
        assert axes.get_xscale() == "log"


def beats(one, other):
    """At most as costly, at least as good, and not the same."""
    return one != other and one[0] <= other[0] and one[1] >= other[1]


def test_marks_in_the_legend_are_those_of_the_panel(canvas, tmp_path):
    found = two_methods()
    pareto(found, DRIVESTUDIO, PARETO_COSTS[0], tmp_path / "p.svg")
    (legend,) = canvas["p.svg"].legends
    handles = {text.get_text(): handle for text, handle in zip(legend.get_texts(), legend.legend_handles, strict=True)}
    assert list(handles) == ["a", "b", "plain", "paper", "control: random", "removal", "front of the means"]
    assert [handles[name].get_color() for name in ("a", "b", "control: random")] == [*COLORS[:2], GREY]
    assert [handles[name].get_marker() for name in list(handles)[2:6]] == ["o", "s", "x", "D"]
    assert [styles(found)[variant.name].marker for variant in found] == ["o", "s", "x", "o", "D"]


def test_a_figure_of_one_region_or_none(canvas, tmp_path):
    only = variants([record(make_summary("a", vehicle_psnr=None))])
    assert pareto(only, DRIVESTUDIO, PARETO_COSTS[0], tmp_path / "p.svg")
    assert [axes.get_title() for axes in canvas["p.svg"].axes] == ["full image"]
    canvas.clear()
    assert not pareto(only, STRICT, PARETO_COSTS[0], tmp_path / "p.svg")
    assert not pareto(
        variants([record(make_summary("a", training_seconds=None))]), DRIVESTUDIO, PARETO_COSTS[3], tmp_path / "p"
    )
    assert canvas == {}


def test_bars_of_a_frame_lie_behind_each_other(canvas, tmp_path):
    """Each variant has a row, each part a color, as wide as the mean over its runs; an effect is hatched."""
    parts, runs = {"a": (3.0, 1.0, 0.5), "a+paper": (1.5, 0.25, 0.75)}, []
    for name, (road, cars, sky) in parts.items():
        for seed, less in enumerate((0.125, -0.125)):
            folder = tmp_path / f"{name}{seed}"
            nodes = {node: NodeCost(10, 0.1, 4.0, ms - less) for node, ms in (("road", road), ("cars", cars))}
            update_costs(folder, nodes=nodes, effects={"sky": sky - less})
            runs.append(record(make_summary(name, seed), str(folder)))
    found = variants(runs)
    assert frame_waterfall(found, tmp_path / "w.svg")
    (axes,) = canvas["w.svg"].axes
    bars = [
        (bar.get_y() + bar.get_height() / 2, bar.get_x(), bar.get_width()) for bar in axes.patches if bar.get_width()
    ]
    expected = [
        (row, sum(values[:place]), value)
        for row, values in enumerate(parts.values())
        for place, value in enumerate(values)
    ]
    assert bars == [pytest.approx(bar) for bar in expected]
    paint = [to_hex(bar.get_facecolor()) for bar in axes.patches]
    assert paint == [color.lower() for color in COLORS[:3]] * 3
    assert [bar.get_hatch() for bar in axes.patches] == [None, None, "//"] * 3
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a", "a+paper"]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the first on top
    (legend,) = canvas["w.svg"].legends
    assert [text.get_text() for text in legend.get_texts()] == ["road", "cars", "effect: sky"]
    assert [to_hex(one.get_facecolor()) for one in legend.get_patches()] == paint[:3]


@pytest.mark.parametrize("clock", ["frames", "training"])
def test_axes_of_times_carry_the_mark_of_a_machine_that_was_not_quiet(canvas, tmp_path, clock):
    loud, folder = disturbed(make_summary("a+paper"), clock), tmp_path / "loud"
    HELD_OUT_CURVE.write(folder, [HeldOutLook(10.0, 9, 20.0, 1.0, 2.0)])
    update_costs(folder, effects={"sky": 0.5}, noise=loud.latency.noise)
    found = variants([record(make_summary("a"), str(tmp_path / "calm")), record(loud, str(folder))])
    for cost in PARETO_COSTS:
        assert pareto(found, DRIVESTUDIO, cost, tmp_path / f"{cost[0]}.svg")
    assert held_out_over_time(found, tmp_path / "held_out.svg")
    assert frame_waterfall(found, tmp_path / "waterfall.svg")
    marked = {name for name, figure in canvas.items() if figure.axes[0].get_xlabel().endswith(" §")}
    assert marked == {"frames": {"frame.svg", "waterfall.svg"}, "training": {"training.svg", "held_out.svg"}}[clock]


def test_a_curve_is_the_runs_own(canvas, tmp_path):
    """A panel a method, two runs of one seed in the first; colors and dashes tell sparsifications apart, controls are
    gray. Counts are of all nodes: one is pruned to 50 of 100 Gaussians and more, the other keeps its 7."""
    runs = []
    for place, name in enumerate(("a", "a", "a+paper", "a+capped", "b")):
        folder = tmp_path / str(place)
        HELD_OUT_CURVE.write(folder, [HeldOutLook(10.0 + place, 9, 20.0 + place, 1.0, 2.0),
                                      HeldOutLook(30.0 + place, 19, 25.0 - place, 1.0, 2.0)])  # fmt: skip
        rows = 100 * (place + 1)
        starts = [CountChange(0, node, 0, count, "start") for node, count in (("x", rows), ("y", 7))]
        LEDGER.write(folder, [*starts, CountChange(5, "x", rows, 50, PRUNING)])
        runs.append(record(make_summary(name), str(folder)))
    found = variants(runs)
    for draw, x_label, y_label, drawn in (
        (held_out_over_time, "training seconds", "held-out PSNR, dB",
         [([10.0 + place, 30.0 + place], [20.0 + place, 25.0 - place]) for place in range(5)]),
        (counts_over_time, "step", "Gaussians", [([0, 5], [100 * (place + 1) + 7, 57]) for place in range(5)]),
    ):  # fmt: skip
        assert draw(found, tmp_path / "c.svg")
        one, other = canvas["c.svg"].axes
        assert [(axes.get_title(), axes.get_xlabel()) for axes in (one, other)] == [("a", x_label), ("b", x_label)]
        assert [axes.get_ylabel() for axes in (one, other)] == [y_label, ""]
        lines, dots = [], []
        for line in (*one.get_lines(), *other.get_lines()):
            (dots if line.get_linestyle() == "None" else lines).append(line)
        assert [tuple(np.asarray(part).tolist() for part in line.get_data()) for line in lines] == drawn
        pruned = [([5], [57])] * 5 if draw is counts_over_time else []
        assert [tuple(np.asarray(part).tolist() for part in line.get_data()) for line in dots] == pruned
        looks = [(line.get_label(), line.get_color(), line.get_linestyle()) for line in lines]
        assert looks == [
            *[("plain", COLORS[0], "-")] * 2,
            ("paper", COLORS[1], "-"),
            ("control: capped", GREY, ":"),
            ("plain", COLORS[0], "-"),
        ]
        legends = [[text.get_text() for text in axes.get_legend().get_texts()] for axes in (one, other)]
        assert legends == [["plain", "paper", "control: capped"], ["plain"]]


@pytest.mark.lengthy
def test_figures_are_named_and_what_is_absent_is_said(tmp_path):
    found = two_methods()
    drawn, absent = _figures(found, DRIVESTUDIO, tmp_path)
    assert [caption.partition(":")[0] for caption, _ in drawn] == [
        f"Held-out PSNR against {label}" for label in ("Gaussians", "MB", "milliseconds a frame", "training minutes")
    ]
    assert [note.partition(":")[0] for note in absent] == [
        "no curves of held-out PSNR over seconds", "no counts over time", "no milliseconds by node and effect",
    ]  # fmt: skip
    names = [f"pareto_{name}" for name in ("frame", "gaussians", "megabytes", "training")]
    assert sorted(path.stem for path in tmp_path.iterdir()) == names
    for (_, svg), cost in zip(drawn, PARETO_COSTS, strict=True):
        assert svg == (tmp_path / f"pareto_{cost[0]}.svg").read_text()


def test_marks_say_what_they_are(found, tmp_path):
    """Three streets: a run each, and a mean, in the order in which they are drawn; names of groups are not left."""
    assert pareto(found, DRIVESTUDIO, PARETO_COSTS[0], tmp_path / "a.svg")
    text = (tmp_path / "a.svg").read_text()
    said = re.findall(r"<use [^>]*><title>([^<]+)</title></use>", text)
    assert said[:3] == [
        f"streetgs, street {seed}, seed {seed}: {25 + seed}.000 dB, 10,000 Gaussians" for seed in range(3)
    ]
    assert said.count("streetgs, mean: 26.000 dB, 10,000 Gaussians") == 1
    assert len(said) == 4 * 3 * 2  # three runs and a mean of three variants, in two panels
    assert ' runs"' not in text
    figure, (axes,) = panels(1)
    axes.scatter([1.0], [2.0], gid="one")
    with pytest.raises(ValueError, match="1 marks in 'one', and 2 texts"):
        write_svg(figure, tmp_path / "b.svg", {"one": ["a <b>", "c"]})
    write_svg(figure, tmp_path / "b.svg", {"one": ["a <b>"]})
    assert "<title>a &lt;b&gt;</title>" in (tmp_path / "b.svg").read_text()


RULES = [
    (sparsify, kind) for sparsify in ("paper_short", "paper", "mine", "yours") for kind in ("importance", "volume", "x")
]


def of_a_sweep(folder):
    """Twelve variants of one method: four sparsifications with three rules each, told apart by a group alone."""
    for index, (sparsify, kind) in enumerate(RULES):
        run = folder / f"{index}"
        command = f"sparsestreet train sparsify={sparsify} pruning@callback.pruning.rule={kind}"
        config = {"callback.pruning.rule._target_": kind}
        yield record(
            make_summary(
                f"streetgs+{sparsify}", 0, 20.0 + index / 7, {"a": 1000 + 90 * index}, config=config, command=command
            ),
            str(run),
        )


def test_every_arm_of_a_figure_has_a_look_of_its_own(tmp_path):
    """By color and marker in the scatter, by color and dash over time, with its own entry in the legend."""
    found = variants(list(of_a_sweep(tmp_path)))
    assert len(found) == len(RULES)
    drawn = styles(found).values()
    for look in (
        {(one.color, one.marker) for one in drawn},
        {(one.color, one.dashes) for one in drawn},
        {one.kind for one in drawn},
    ):
        assert len(look) == len(RULES)
    assert "mine pruning=volume" in {one.kind for one in drawn}
    # Sparsifications that other figures draw alike, or do not know, in two methods.
    pairs = [
        make_summary(f"{method}+{sparsify}")
        for method in "ab"
        for sparsify in ("paper", "paper_short", "mine", "other")
    ]
    drawn = styles(variants([record(one) for one in pairs])).values()
    assert len({(one.method, one.marker) for one in drawn}) == len(pairs)


def test_names_of_bars_do_not_run_into_each_other(tmp_path, canvas):
    runs = list(of_a_sweep(tmp_path))[:4]
    runs = [
        record(
            replace(
                one.summary,
                run=replace(one.summary.run, label="streetgs@all_rigid-drivestudio_legacy_scaled+paper_short"),
            ),
            str(one.folder),
        )
        for one in runs
    ]
    for one in runs:
        update_costs(one.folder, nodes={"rigid": NodeCost(10, 0.1, 4.0, 1.0)})
    frame_waterfall(variants(runs), tmp_path / "w.svg")
    figure = canvas["w.svg"]
    FigureCanvasAgg(figure).draw()
    boxes = [text.get_window_extent() for text in figure.axes[0].get_yticklabels()]
    assert len(boxes) == 3  # two of the runs are of one variant
    assert not any(one.overlaps(other) for index, one in enumerate(boxes) for other in boxes[:index])


def test_without_held_out_views_there_is_none(tmp_path):
    found = variants([record(make_summary(psnr=None, training_psnr=20.0, split="none"))])
    with pytest.raises(ValueError, match="no run was evaluated on held-out views"):
        time_figure(found, DRIVESTUDIO, tmp_path / "time.png")


def test_arms_of_one_method_differ_in_color_and_those_of_several_by_method():
    one = variants([record(make_summary(label)) for label in ("a", "a+paper")])
    assert len({_paint(styles(one), variant) for variant in one}) == 2
    several = [*one, *variants([record(make_summary("b"))])]
    assert len({_paint(styles(several), variant) for variant in one}) == 1
    assert len({_paint(styles(several), variant) for variant in several}) == 2


def figure_of(runs, tmp_path, monkeypatch):
    """The panels of training and of frames."""
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **how: drawn.append((self, path, how)))
    time_figure(variants(runs), DRIVESTUDIO, tmp_path / "deep" / "time.png")
    ((figure, path, how),) = drawn
    assert path == tmp_path / "deep" / "time.png"
    assert (how["dpi"], how["facecolor"]) == (150, "white")
    return figure, *figure.axes


def test_without_curves_runs_and_means_are_points(tmp_path, monkeypatch):
    """Two seeds of one scene and one of another: 24 dB at 30 ms and 300 s, and 20 dB at 60 ms and 100 s."""
    runs = [
        record(make_summary("m", seed, psnr, scene=scene, milliseconds=ms, training_seconds=seconds))
        for seed, psnr, scene, ms, seconds in
        ((0, 23.0, "x", 20.0, 200.0), (1, 25.0, "x", 40.0, 400.0), (0, 20.0, "y", 60.0, 100.0))
    ]  # fmt: skip
    control = record(make_summary("m+random", 0, 1.0, milliseconds=1.0, scene="x"))
    figure, training, frame = figure_of([*runs, control], tmp_path, monkeypatch)
    assert (training.get_xlabel(), frame.get_xlabel()) == ("training seconds", "milliseconds a frame")
    assert training.get_ylabel() == "held-out PSNR, dB"
    for axes, costs, mean in ((training, (200.0, 400.0, 100.0), 200.0), (frame, (20.0, 40.0, 60.0), 45.0)):
        single, whole = (one.get_offsets().tolist() for one in axes.collections)
        assert sorted(single) == sorted(map(list, zip(costs, (23.0, 25.0, 20.0), strict=True)))
        assert whole == [[mean, 22.0]]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["m"]


def test_curves_are_means_with_a_mark_at_their_end(tmp_path, monkeypatch):
    runs = []
    for seed in (0, 1):
        for label, less in (("m", 0.0), ("m+paper", 4.0)):
            folder = tmp_path / f"{label}{seed}"
            looks = [HeldOutLook(10.0 * at + 2 * seed, at, 20.0 + at + seed - less, 1.0, 2.0) for at in (1, 2, 3)]
            HELD_OUT_CURVE.write(folder, looks)
            runs.append(record(make_summary(label, seed), str(folder)))
    _, training, frame = figure_of(runs, tmp_path, monkeypatch)
    plain, paper = training.get_lines()
    for line, less in ((plain, 0.0), (paper, 4.0)):
        assert [np.asarray(part).tolist() for part in line.get_data()] == [
            [11.0, 21.0, 31.0], [21.5 - less, 22.5 - less, 23.5 - less],
        ]  # fmt: skip
        assert line.get_markevery() == [2]
    assert [(line.get_label(), line.get_linestyle(), line.get_marker()) for line in (plain, paper)] == [
        ("m", "-", "o"), ("m+paper", "--", "s"),
    ]  # fmt: skip
    assert plain.get_color() != paper.get_color()
    assert len(frame.collections) == 4
