"""Cells as Markdown, LaTeX and CSV."""

import csv
import io

import pytest

from sparsestreet.report.tables import Cell, Grid, comma_separated, latex, markdown

GRID = Grid(
    "some",
    "A title",
    (("", "arm"), ("novel views", "PSNR"), ("novel views", "PSNR, paper")),
    ((Cell("a_b|c"), Cell("-0.3", bold=True, runs=("r1", "r2")), Cell("29.86", published=True)),),
    ("5 % more",),
)


def test_markdown():
    assert "| arm | novel views PSNR | novel views PSNR, paper |\n| --- | ---: | ---: |\n" in markdown([GRID])
    assert "| a_b\\|c | **-0.3** | 29.86 |" in markdown([GRID])


def test_latex():
    text = latex([GRID])
    assert "\\multicolumn{1}{c}{} & \\multicolumn{2}{c}{novel views} \\\\" in text
    assert "a\\_b|c & \\textbf{-0.3} & \\textit{29.86} \\\\" in text
    assert "5 \\% more" in text


def test_csv_says_whose_a_number_is():
    _, ours, theirs = csv.reader(io.StringIO(comma_separated([GRID])))
    assert ours == ["some", "a_b|c", "novel views PSNR", "-0.3", "0", "1", "r1 r2"]
    assert theirs[3:] == ["29.86", "1", "0", ""]


def test_a_row_of_another_width_is_refused():
    with pytest.raises(ValueError, match="a row has 1 cells, the header 3"):
        Grid("some", "", GRID.header, ((Cell("a"),),), ())
