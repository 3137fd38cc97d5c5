"""Plots: the values that were drawn, read back from the figure."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from sparsestreet.pictures import plots
from sparsestreet.pictures.images import Dots, Marked, Places
from sparsestreet.pictures.plots import draw_evidence, draw_history, plot_counts, plot_psnr
from sparsestreet.records.curves import LEDGER, MASK, PRUNING, CountChange
from sparsestreet.records.run import RUN
from sparsestreet.training.callbacks import sparsify
from tests.evaluation.frames import make_run

pytestmark = pytest.mark.lengthy


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    """The figures saved during a test."""
    figures = []
    save = Figure.savefig

    def remember(figure, path):
        figures.append(figure)
        save(figure, path)

    monkeypatch.setattr(Figure, "savefig", remember)
    return figures


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.axes[0].get_legend().get_texts()]


def test_counts_with_events(tmp_path, drawn):
    path = tmp_path / "some" / "plots" / "counts.png"
    counts = {"background": [100, 1200, 400], "rigid": [0, 50, 50]}
    plot_counts(path, [0, 10, 20], counts, [(15, "prune"), (18, "prune"), (20, "mask")])
    assert path.read_bytes().startswith(b"\x89PNG")
    axes = drawn[0].axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert list(lines["background (400)"].get_ydata()) == [100, 1200, 400]
    assert list(lines["rigid (50)"].get_xdata()) == [10, 20]  # zero has no place on a logarithmic axis
    assert [line.get_xdata()[0] for line in axes.lines if len(line.get_xdata()) == 2 and line.get_zorder() == 0] == [
        15,
        18,
        20,
    ]
    assert legend_of(drawn[0]) == ["background (400)", "rigid (50)", "prune", "mask"]


def test_counts_have_one_kind_of_labels(tmp_path, drawn):
    """From 9,000 to 40,000 only one tick is a power of ten."""
    plot_counts(tmp_path / "counts.png", [0, 9], {"background": [9000, 40_000]})
    labels = [text.get_text() for text in drawn[0].axes[0].get_yticklabels(which="both")]
    assert {"10k", "20k"} <= set(labels)
    assert not any("times" in label or "^" in label for label in labels)


def test_every_plot_says_what_it_shows(tmp_path, drawn):
    plot_counts(tmp_path / "a.png", [0, 5], {"road": [10, 20]})
    plot_psnr(tmp_path / "b.png", {"plain": ([0, 5], [10.0, 20.0])})
    plot_psnr(tmp_path / "b.png", {"plain": ([0, 5], [10.0, 20.0])}, (), "other", "seconds")
    said = [(axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) for axes in (figure.axes[0] for figure in drawn)]
    assert said == [
        ("Gaussians per node", "step", "Gaussians"),
        ("PSNR over training", "step", "PSNR (dB)"),
        ("other", "seconds", "PSNR (dB)"),
    ]
    scales = [(axes.get_xscale(), axes.get_yscale()) for axes in (figure.axes[0] for figure in drawn)]
    assert scales == [("linear", "log"), ("linear", "linear"), ("linear", "linear")]
    assert drawn[0].axes[0].lines[0].get_drawstyle() == "steps-post"
    formatter = drawn[0].axes[0].yaxis.get_major_formatter()
    assert [formatter(value, 0) for value in (950.0, 1000.0, 12_500.0, 1e6)] == ["950", "1k", "12.5k", "1M"]


def test_events_of_one_name_share_a_style_behind_the_curves(tmp_path, drawn):
    events = [(3, "mask"), (5, "prune"), (7, "mask"), (9, "reset"), (11, "more")]
    plot_psnr(tmp_path / "psnr.png", {"plain": ([0, 20], [10.0, 20.0])}, events)
    curve, *lines = drawn[0].axes[0].lines
    marks, named = lines[:5], lines[5:]
    assert [line.get_xdata()[0] for line in marks] == [3, 5, 7, 9, 11]
    assert {line.get_zorder() for line in marks} == {0}
    assert curve.get_zorder() > 0
    assert [line.get_linestyle() for line in marks] == ["--", ":", "--", "-.", "--"]
    assert [(line.get_label(), line.get_linestyle()) for line in named] == [
        ("mask", "--"), ("prune", ":"), ("reset", "-."), ("more", "--"),
    ]  # fmt: skip


def test_a_plot_without_a_name_has_no_legend(tmp_path, drawn):
    plot_psnr(tmp_path / "deep" / "psnr.png", {})
    assert drawn[0].axes[0].get_legend() is None
    plot_counts(tmp_path / "counts.png", [], {"sky": []})  # of no step: empty, not an error
    assert len(drawn) == 2


CHANGES = [
    CountChange(0, "background", 0, 100, "seeds"),
    CountChange(0, "rigid", 0, 20, "seeds"),
    CountChange(10, "background", 100, 130, "densify"),
    CountChange(10, "background", 130, 120, "cull"),
    CountChange(20, "rigid", 20, 15, MASK),
    CountChange(20, "background", 120, 90, MASK),
    CountChange(30, "background", 90, 40, PRUNING),
]


@pytest.fixture
def drawn_history(monkeypatch):
    """What was handed to the plots, by the file's name."""
    calls = {}
    monkeypatch.setattr(plots, "plot_counts", lambda path, *rest: calls.update({path.name: rest}))
    monkeypatch.setattr(plots, "plot_psnr", lambda path, *rest: calls.update({path.name: rest}))
    return calls


def test_counts_stay_between_changes_and_events_are_marked(tmp_path, drawn_history):
    LEDGER.write(tmp_path, CHANGES)
    draw_history(tmp_path)
    steps, counts, events = drawn_history["counts.png"]
    assert steps == [0, 10, 20, 30]
    assert counts == {"background": [100, 120, 90, 40], "rigid": [20, 20, 15, 15]}
    assert events == [(20, "mask"), (30, "pruning")]
    assert "psnr.png" not in drawn_history


def test_the_callbacks_give_the_reasons_that_are_marked():
    assert set(plots.MARKED) == {sparsify.MASKED, sparsify.PRUNED}


def test_psnr_is_taken_where_it_was_logged(tmp_path, drawn_history):
    LEDGER.write(tmp_path, CHANGES)
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "metrics.csv").write_text(
        "epoch,psnr,step,train/l1,val/psnr\n0,20.5,9,0.1,\n0,,9,,18.25\n1,21.5,19,0.1,\n"
    )
    draw_history(tmp_path)
    curves, events, title = drawn_history["psnr.png"]
    assert title == "PSNR over training"
    assert curves == {"training, running mean": ((9, 19), (20.5, 21.5)), "held out": ((9,), (18.25,))}
    assert events == [(20, "mask"), (30, "pruning")]


def test_held_out_views_are_drawn_over_seconds(tmp_path, drawn_history):
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "held_out.csv").write_text(
        "seconds,step,psnr_full,psnr_human,psnr_vehicle\n1.500,10,20.5,,19.5\n3.000,20,21.5,,20.0\n"
    )
    draw_history(tmp_path)
    curves, events, title, along = drawn_history["held_out.png"]
    assert curves == {"full image": ((1.5, 3.0), (20.5, 21.5)), "vehicles": ((1.5, 3.0), (19.5, 20.0))}
    assert (events, along) == ((), "seconds")
    assert "without evaluation" in title


def test_files_that_were_not_written_leave_their_picture_out(tmp_path, drawn_history):
    draw_history(tmp_path)
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "metrics.csv").write_text("epoch,step\n0,9\n")
    draw_history(tmp_path)
    assert drawn_history == {}


def test_the_pictures_are_drawn(tmp_path):
    LEDGER.write(tmp_path, CHANGES)
    draw_history(tmp_path)
    assert (tmp_path / "curves" / "counts.png").read_bytes().startswith(b"\x89PNG")


def test_a_curve_reaches_the_last_step_and_says_that_nothing_was_held_out(tmp_path, drawn_history):
    """The last change is at step 30 of 400, and validation never came."""
    LEDGER.write(tmp_path, CHANGES)
    RUN.write(tmp_path, make_run(steps=400))
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "metrics.csv").write_text("epoch,psnr,step\n0,20.5,9\n")
    draw_history(tmp_path)
    steps, counts, _ = drawn_history["counts.png"]
    assert (steps[-2:], counts["background"][-2:]) == ([30, 400], [40, 40])
    assert "no look at held-out views: trainer.val_check_interval" in drawn_history["psnr.png"][2]


IMAGE = np.full((20, 30, 3), 128, np.uint8)
LOWER = np.arange(20)[:, None] >= np.full(30, 10)


def read(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def reddish(path: Path) -> float:
    """Share of the picture whose red is far above its green."""
    pixels = read(path).astype(int)
    return float((pixels[..., 0] - pixels[..., 1] > 60).mean())


@pytest.mark.parametrize(("mask", "marked"), [(LOWER, True), (np.zeros_like(LOWER), False)])
def test_marked_pixels_are_red(tmp_path, mask, marked: bool):
    draw_evidence(tmp_path / "evidence.png", "a street", [Marked("hood", IMAGE, mask)])
    assert (reddish(tmp_path / "evidence.png") > 0.02) is marked


def test_a_cell_for_each_panel_in_two_columns(tmp_path):
    places = Places("shear", IMAGE, np.array([[3.0, 4.0], [20.0, 10.0]]), np.array([0.0, 2.0]), "px")
    dots = Dots("gains", "s", "EV", {"camera 0": ([0.0, 1.0], [0.1, -0.1])}, joined=True, diagonal=True)
    for number, panels in enumerate(([dots, places], [dots, places, Marked("hood", IMAGE, LOWER)])):
        draw_evidence(tmp_path / f"{number}.png", "a street", panels)
    small, large = (read(tmp_path / f"{number}.png").shape for number in (0, 1))
    assert small[1] == large[1]
    assert large[0] - small[0] == 330  # a line of cells, 3.3 inches


def test_nothing_is_no_picture(tmp_path):
    with pytest.raises(ValueError, match="needs a panel"):
        draw_evidence(tmp_path / "evidence.png", "a street", [])
