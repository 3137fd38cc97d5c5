"""The figure of quality against time."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from sparsestreet.metrics.definitions import DRIVESTUDIO
from sparsestreet.records.held_out import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.report import collect
from sparsestreet.report.arms import arms
from sparsestreet.report.figures_readme import _paint, time_figure
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import record, write_sweep


@pytest.mark.lengthy
@pytest.mark.parametrize("curves", [True, False])
def test_it_is_written_with_and_without_curves(tmp_path, curves):
    found = arms(collect([write_sweep(tmp_path / "sweep", curves=curves)]))
    time_figure(found, DRIVESTUDIO, tmp_path / "docs" / "figures" / "time.png")
    assert (tmp_path / "docs" / "figures" / "time.png").read_bytes().startswith(b"\x89PNG")


def test_without_held_out_views_there_is_none(tmp_path):
    found = arms([record(make_summary(psnr=None, training_psnr=20.0, split="none"))])
    with pytest.raises(ValueError, match="no run was evaluated on held-out views"):
        time_figure(found, DRIVESTUDIO, tmp_path / "time.png")


def test_arms_of_one_method_differ_in_color_and_those_of_several_by_method():
    one = arms([record(make_summary(label)) for label in ("a", "a+paper")])
    assert len({_paint(arm, one) for arm in one}) == 2
    several = [*one, *arms([record(make_summary("b"))])]
    assert len({_paint(arm, several) for arm in one}) == 1
    assert len({_paint(arm, several) for arm in several}) == 2


def figure_of(runs, tmp_path, monkeypatch):
    """The panels of training and of frames."""
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **how: drawn.append((self, path, how)))
    time_figure(arms(runs), DRIVESTUDIO, tmp_path / "deep" / "time.png")
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
