"""Plots: the values that were drawn, read back from the figure."""

import pytest
from matplotlib.figure import Figure

from sparsestreet.pictures.plots import plot_counts, plot_psnr, plot_runs


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
    path = tmp_path / "plots" / "counts.png"
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
