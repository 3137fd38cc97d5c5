"""Plots: the values that were drawn, read back from the figure."""

import pytest
from matplotlib.figure import Figure

from sparsestreet.pictures.plots import plot_counts, plot_psnr, plot_runs

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
    with pytest.raises(ValueError, match="counts of 'rigid' have 1 samples, steps 2"):
        plot_counts(path, [0, 1], {"rigid": [3]})


def test_plots_of_nothing_are_empty_not_errors(tmp_path, drawn):
    plot_counts(tmp_path / "counts.png", [], {"sky": []})
    plot_psnr(tmp_path / "psnr.png", {})
    assert len(drawn) == 2


def test_psnr_curves(tmp_path, drawn):
    plot_psnr(tmp_path / "psnr.png", {"plain": ([0, 5], [10.0, 20.0])}, [(3, "mask")])
    line, mark, _ = drawn[0].axes[0].lines
    assert list(line.get_ydata()) == [10.0, 20.0]
    assert list(mark.get_xdata()) == [3, 3]
    assert legend_of(drawn[0]) == ["plain", "mask"]


def test_runs_are_points_in_the_color_of_their_name(tmp_path, drawn):
    plot_runs(tmp_path / "runs.png", {"plain": [(1000, 25.0), (1000, 26.0)], "ours": [(310, 24.0)]})
    plain, ours = drawn[0].axes[0].collections
    assert plain.get_offsets().tolist() == [[1000, 25], [1000, 26]]
    assert ours.get_offsets().tolist() == [[310, 24]]
    assert plain.get_facecolor().tolist() != ours.get_facecolor().tolist()
    assert legend_of(drawn[0]) == ["plain (n=2)", "ours (n=1)"]


@pytest.mark.lengthy
def test_no_two_variants_of_a_plot_look_alike(tmp_path, drawn):
    """More than there are colors, or markers."""
    plot_runs(tmp_path / "runs.png", {f"m{place}": [(1000 * (place + 1), 20.0)] for place in range(20)})
    looks = {
        (str(one.get_paths()[0].vertices.tolist()), tuple(one.get_facecolor()[0]))
        for one in drawn[0].axes[0].collections
    }
    assert len(looks) == 20


def test_counts_have_one_kind_of_labels(tmp_path, drawn):
    """From 9,000 to 40,000 only one tick is a power of ten."""
    plot_counts(tmp_path / "counts.png", [0, 9], {"background": [9000, 40_000]})
    labels = [text.get_text() for text in drawn[0].axes[0].get_yticklabels(which="both")]
    assert {"10k", "20k"} <= set(labels)
    assert not any("times" in label or "^" in label for label in labels)


def test_every_plot_says_what_it_shows(tmp_path, drawn):
    plot_counts(tmp_path / "a.png", [0, 5], {"road": [10, 20]})
    plot_counts(tmp_path / "a.png", [0, 5], {"road": [10, 20]}, title="mine")
    plot_psnr(tmp_path / "b.png", {"plain": ([0, 5], [10.0, 20.0])})
    plot_psnr(tmp_path / "b.png", {"plain": ([0, 5], [10.0, 20.0])}, (), "other", "seconds")
    plot_runs(tmp_path / "c.png", {"plain": [(1000, 25.0)]})
    plot_runs(tmp_path / "c.png", {"plain": [(1000, 25.0)]}, "third")
    said = [(axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) for axes in (figure.axes[0] for figure in drawn)]
    assert said == [
        ("Gaussians per node", "step", "Gaussians"),
        ("mine", "step", "Gaussians"),
        ("PSNR over training", "step", "PSNR (dB)"),
        ("other", "seconds", "PSNR (dB)"),
        ("Quality against size", "Gaussians", "held-out PSNR, full image (dB)"),
        ("third", "Gaussians", "held-out PSNR, full image (dB)"),
    ]
    scales = [(axes.get_xscale(), axes.get_yscale()) for axes in (figure.axes[0] for figure in drawn[::2])]
    assert scales == [("linear", "log"), ("linear", "linear"), ("log", "linear")]
    assert drawn[0].axes[0].lines[0].get_drawstyle() == "steps-post"
    numbers = [formatter(value, 0) for formatter in (drawn[0].axes[0].yaxis.get_major_formatter(),
               drawn[4].axes[0].xaxis.get_major_formatter(), drawn[4].axes[0].xaxis.get_minor_formatter())
               for value in (950.0, 1000.0, 12_500.0, 1e6)]  # fmt: skip
    assert numbers == ["950", "1k", "12.5k", "1M"] * 3


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
