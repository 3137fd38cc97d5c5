"""What the figures of the measurements draw."""

import math
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from sparsestreet.bench import figures
from sparsestreet.bench.figures import (
    _sparse,
    _steps,
    draw_pareto,
    forward_time,
    gradient_l2,
    image_rmse,
    save_figure,
    whole_time,
)
from tests.typed import as_a


def record(
    forward: float, backward: float, psnr: float | None, gradient: float | None, knob: str = "alpha_min", **changes: Any
) -> figures.Record:
    stages = {name: {"minimum": ms, "median": 3 * ms} for name, ms in (("forward", forward), ("backward", backward))}
    gradients = {"means": {"relative_l2": gradient}, "sh": {"relative_l2": 1e-9}}
    exact = {"image": {"psnr": psnr, "mean": 7.0}, "gradients": gradients}
    made = {"kind": "knob", "scene": "one", "knob": knob, "value": "1/64", "preset": None, "other_model": False}
    return {**made, "times": {"stages": stages}, "exact": exact, **changes}


RECORDS = [
    record(1.0, 7.0, 40.0, 1e-2),
    record(2.0, 1.0, 60.0, 1e-3, knob="default", preset="default"),
    record(4.0, 3.0, None, 1e-1, knob="preset", preset="exact"),
    record(8.0, 1.0, 20.0, 1e-4, knob="effects", other_model=True),
    record(3.0, 3.0, 50.0, 1e-3, scene="two"),
    record(9.0, 9.0, 10.0, 1.0, kind="small"),
    record(9.0, 9.0, 10.0, 1.0) | {"exact": None},
]


@pytest.fixture
def saved(monkeypatch) -> dict[str, Figure]:
    drawn: dict[str, Figure] = {}
    monkeypatch.setattr(
        figures, "save_figure", lambda figure, folder, name: drawn.update({name: figure}) or [folder / name]
    )
    return drawn


def test_numbers_of_a_point():
    one = RECORDS[0]
    assert (forward_time(one), whole_time(one)) == (1.0, 8.0)
    assert image_rmse(one) == pytest.approx(0.01)
    assert image_rmse(RECORDS[2]) == 1e-8
    assert image_rmse(record(1.0, 1.0, 300.0, 1.0)) == 1e-8
    assert gradient_l2(one) == 1e-2
    assert gradient_l2(record(1.0, 1.0, 1.0, None)) == math.inf
    assert gradient_l2(record(1.0, 1.0, 1.0, 1e-12)) == 1e-8


def places(axes: Axes) -> dict[str, list[tuple[float, float]]]:
    return {
        str(one.get_label()): [tuple(p) for p in np.asarray(one.get_offsets()).tolist()] for one in axes.collections
    }


def test_a_panel_a_scene_and_a_figure_an_error(saved, tmp_path):
    assert draw_pareto(RECORDS, tmp_path) == [tmp_path / "pareto_image", tmp_path / "pareto_gradient"]
    for name, x, y, labels in (
        ("pareto_image", (1.0, 2.0, 4.0, 8.0, 3.0), (1e-2, 1e-3, 1e-8, 1e-1, 10**-2.5), ("forward, ms", "image: RMS")),
        (
            "pareto_gradient",
            (8.0, 3.0, 7.0, 9.0, 6.0),
            (1e-2, 1e-3, 1e-1, 1e-4, 1e-3),
            ("forward + b", "gradient: rel"),
        ),
    ):
        figure = saved[name]
        one, two, legend = figure.axes
        assert [axes.get_title() for axes in (one, two)] == ["one", "two"]
        assert (figure.get_supxlabel()[:11], figure.get_supylabel()[: len(labels[1])]) == labels
        assert (one.get_xscale(), one.get_yscale()) == ("log", "log")
        expected = [pytest.approx(place) for place in zip(x, y, strict=True)]
        names = ["alpha min", "default", "preset", "effects (another model)"]
        assert list(places(one)) == names
        assert [some for (some,) in places(one).values()] == expected[:4]
        assert list(places(two).values()) == [[expected[4]]]
        filled = [len(part.get_facecolor()) == 1 for part in one.collections]
        assert filled == [True, True, True, False]
        assert [part.get_sizes().tolist()[0] for part in one.collections] == [46.0, 120.0, 46.0, 46.0]
        assert to_hex(one.collections[0].get_edgecolor()[0]) == "#0072b2"
        (line,) = one.get_lines()
        front = {"pareto_image": (0, 1, 2), "pareto_gradient": (1,)}[name]
        drawn = list(zip(*(np.asarray(part).tolist() for part in line.get_data()), strict=True))
        assert drawn == [expected[index] for index in front]
        assert line.get_drawstyle() == "steps-post"
        # Presets, and of the front what lowers the error by a third.
        written = {text.get_text() for text in one.texts}
        assert written == {"default", "exact", *(["alpha min 1/64"] if name == "pareto_image" else [])}
        assert {text.get_text() for text in legend.get_legend().get_texts()} == {"Pareto front", *names}


def test_an_error_without_a_scale_is_not_drawn(saved, tmp_path):
    draw_pareto([*RECORDS[:2], record(5.0, 5.0, 30.0, None)], tmp_path)
    assert [len(places(saved[name].axes[0])["alpha min"]) for name in ("pareto_image", "pareto_gradient")] == [2, 1]


@pytest.mark.parametrize(("scenes", "shape"), [(1, (2, 1)), (2, (2, 2)), (3, (2, 3)), (5, (2, 3))])
def test_the_legend_has_the_last_place(saved, tmp_path, scenes, shape):
    draw_pareto([record(1.0, 1.0, 30.0, 1e-2, scene=str(index)) for index in range(scenes)], tmp_path)
    *panels, legend = saved["pareto_image"].axes
    rows, columns = shape
    assert len(panels) == scenes
    assert saved["pareto_image"].get_size_inches().tolist() == pytest.approx([5.4 * columns, 4.6 * rows])
    grids = [axes.get_subplotspec().get_geometry() for axes in (*panels, legend)]
    assert {geometry[:2] for geometry in grids} == {shape}
    assert [geometry[2] for geometry in grids] == [*range(scenes), rows * columns - 1]


def test_names_of_the_front_are_steps_of_a_third():
    def point(error: float, preset: str | None = None) -> figures.PlottedPoint:
        return 1.0, error, {"preset": preset}

    front = [point(1.0), point(0.7), point(0.66), point(0.4, "named"), point(0.3), point(0.2)]
    assert [one[1] for one in _steps(front)] == [1.0, 0.66, 0.2]


def test_marks_of_an_axis_are_1_2_and_5():
    assert [_sparse(value, 0) for value in (0.1, 0.2, 0.3, 1.0, 5.0, 30.0, 200.0)] == [
        *("0.1", "0.2", "", "1", "5", "", "200"),
    ]


def test_a_figure_is_saved_twice_and_the_same_again(tmp_path):
    def saved_in(folder):
        figure = Figure(figsize=(1, 1))
        figure.add_subplot().set_title("a title")
        return save_figure(figure, folder, "some")

    first, second = saved_in(tmp_path / "a" / "b"), saved_in(tmp_path / "c")
    assert [path.name for path in first] == ["some.svg", "some.png"]
    assert first[0].read_text() == second[0].read_text()
    assert ">a title<" in first[0].read_text()  # text stays text
    assert first[1].read_bytes().startswith(b"\x89PNG")


def extents(axes: Axes) -> list[tuple[str, float, float, float]]:
    """Text, left, right and middle of the names beside points, in pixels, by the widths that placed them."""
    found = []
    for text in (as_a(Annotation, one) for one in axes.texts):
        x, y = axes.transData.transform(text.xy).tolist()
        right, up = (part * axes.figure.dpi / 72 for part in text.get_position())
        width = 4.9 * len(text.get_text()) * axes.figure.dpi / 72
        found.append((text.get_text(), x + right, x + right + width, y + up))
    return found


def test_names_keep_clear_of_each_other_and_inside(saved, tmp_path):
    """Twelve at nearly one place, and one at the right edge, whose name stands to its left."""
    crowd = [record(1.0 + 1e-3 * place, 1.0, 40.0 - 1e-3 * place, 1e-2, preset=f"name {place}") for place in range(12)]
    edge = record(50.0, 1.0, 20.0, 1.0, preset="a name that is long enough to leave")
    draw_pareto([*crowd, edge, record(0.5, 1.0, 60.0, 1e-3)], tmp_path)
    axes = saved["pareto_image"].axes[0]
    placed = extents(axes)
    assert len(placed) == 14
    height = 9.5 * axes.figure.dpi / 72
    for place, (text, left, right, middle) in enumerate(placed):
        for other, start, end, level in placed[:place]:
            assert right < start or left > end or abs(middle - level) >= height * (1 - 1e-9), (text, other)
        assert axes.bbox.y0 + height / 2 < middle < axes.bbox.y1 - height / 2
        assert right < axes.bbox.x1
    long = next(text for text in axes.texts if text.get_text().startswith("a name"))
    assert long.get_position()[0] < 0
    moved = [text for text in axes.texts if text.arrow_patch is not None]
    assert {text.get_position()[1] != 0 for text in moved} == {True}
    assert all(text.get_position()[1] == 0 for text in axes.texts if text not in moved)
    assert len(moved) == 11
    assert {text.get_fontweight() for text in axes.texts if text.get_text().startswith("name")} == {"bold"}
    assert [text.get_fontweight() for text in axes.texts if text.get_text() == "alpha min 1/64"] == ["normal"]


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2)])
def test_names_at_one_height_that_are_apart_stay_where_they_are(saved, tmp_path, order):
    times = [(1.0, 30.0, 900.0)[place] for place in order]
    draw_pareto([record(time, 1.0, 40.0, 1e-2, preset=f"at {time:g}") for time in times], tmp_path)
    texts = saved["pareto_image"].axes[0].texts
    assert [text.get_position()[1] for text in texts] == [0.0, 0.0, 0.0]
