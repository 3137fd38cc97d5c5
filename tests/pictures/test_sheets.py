"""Sheets: what is where, and what is written on them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparsestreet.pictures import sheets
from sparsestreet.pictures.images import LIDAR_END, Picture
from sparsestreet.pictures.sheets import SheetColumn, comparison_sheet, draw_effects, picture_sheet
from sparsestreet.records.costs import EffectGain, update_costs
from sparsestreet.records.run import RUN
from tests.evaluation.frames import make_summary
from tests.evaluation.tiles import COLORS, flat, make_picture
from tests.report.test_costs import LENS

LEGEND = {"rigid": (250, 150, 40)}


def order_of(sheet: np.ndarray, row: int) -> list[tuple[int, ...]]:
    """Colors met along a row of pixels, without repeats and without the paper between tiles."""
    paper = tuple(int(value) for value in sheet[-1, -1])
    colors = [tuple(int(value) for value in pixel) for pixel in sheet[row]]
    met = [color for index, color in enumerate(colors) if index == 0 or color != colors[index - 1]]
    return [color for color in met if color != paper]


def row_within(sheet: np.ndarray, color: tuple[int, int, int]) -> int:
    """Middle row of the rows in which a color fills a tile."""
    rows = np.flatnonzero((sheet == color).all(-1).sum(1) >= 100)
    return int(rows[len(rows) // 2])


def error_of(picture: Picture) -> tuple[int, int, int]:
    red, green, blue = (int(value) for value in picture.error[0, 0])
    return red, green, blue


@pytest.fixture
def written(monkeypatch) -> list[str]:
    """The texts on the sheets that a test draws."""
    texts = []
    write = sheets._write

    def remember(draw, position, text, *rest):
        texts.append(text)
        return write(draw, position, text, *rest)

    monkeypatch.setattr(sheets, "_write", remember)
    return texts


def test_sheet_columns_are_truth_render_error_centers():
    sheet = picture_sheet([make_picture()], title="a title", tile_width=120)
    expected = [COLORS["truth"], COLORS["render"], error_of(make_picture()), COLORS["centers"]]
    assert order_of(sheet, row_within(sheet, COLORS["truth"])) == expected


def test_images_of_several_sizes_share_a_sheet():
    tall = Picture(4, 0, *(flat(COLORS[kind], 40) for kind in ("truth", "render", "render", "centers")))
    one = picture_sheet([make_picture()], title="t", tile_width=120)
    both = picture_sheet([make_picture(), tall], title="t", tile_width=120)
    assert both.shape[1] == one.shape[1]
    assert both.shape[0] > one.shape[0] + 40 * 120 // 13
    with pytest.raises(ValueError, match="at least one picture"):
        picture_sheet([], title="t")


def test_the_line_at_the_lidars_end_is_named_where_it_is_drawn(written):
    other, lined = make_picture(), make_picture(4)
    picture_sheet([other], title="t", tile_width=120)
    assert "where the lidar ends" not in written
    lined.error[4] = LIDAR_END
    picture_sheet([other, lined], title="t", tile_width=120)
    assert written.count("where the lidar ends") == 1
    comparison_sheet([SheetColumn(name, "s", [lined], [20.5]) for name in "ab"], title="t", tile_width=120)
    assert written.count("where the lidar ends") == 2


def column(label: str, color: tuple[int, int, int], frame: int = 3) -> SheetColumn:
    return SheetColumn(label, f"{label} size", [make_picture(frame, render=color)], [20.5])


def test_comparison_has_a_column_for_each_run_and_lines_of_renders_errors_and_centers(written):
    colors = [(200, 40, 10), (200, 70, 10), (200, 100, 10)]  # 10, 20 and 30 levels from the truth on average
    columns = [column(f"run{index}", color) for index, color in enumerate(colors)]
    sheet = comparison_sheet(columns, title="t", legend=LEGEND, tile_width=120)
    errors = [error_of(one.pictures[0]) for one in columns]
    assert len(set(errors)) == 3
    rows = [row_within(sheet, color) for color in (COLORS["truth"], errors[0], COLORS["centers"])]
    assert rows == sorted(rows)
    assert order_of(sheet, rows[0]) == [COLORS["truth"], *colors]
    assert order_of(sheet, rows[1]) == errors
    assert (sheet[rows[2]] == COLORS["centers"]).all(-1).sum() == 3 * 120
    assert (sheet == LEGEND["rigid"]).all(-1).sum() >= 100
    for text in (
        "t",
        "truth: frame 3, camera 1",
        "run0",
        "run2",
        "error: 20.50 dB in this image",
        "run1 size",
        "rigid",
    ):
        assert text in written


def test_every_picture_has_its_own_error(written):
    psnr = {"a": [20.0, 21.0], "b": [22.0, 23.0]}
    columns = [SheetColumn(name, "s", [make_picture(3), make_picture(4)], some) for name, some in psnr.items()]
    comparison_sheet(columns, title="t", tile_width=120)
    errors = [text for text in written if text.endswith("dB in this image")]
    assert errors == [f"error: {one}.00 dB in this image" for one in (20, 22, 21, 23)]


def test_only_runs_of_the_same_images_are_compared():
    same = column("plain", COLORS["render"])
    with pytest.raises(ValueError, match=r"different images, \(frame, camera\) \[\[\(3, 1\)\], \[\(4, 1\)\]\]"):
        comparison_sheet([same, column("plain", COLORS["render"], frame=4)], title="t")
    with pytest.raises(ValueError, match="at least two runs, got 1"):
        comparison_sheet([same], title="t")


def height(run: Path) -> int:
    with Image.open(run / "pictures" / "effects.png") as image:
        return image.height


def test_a_row_for_each_effect(tmp_path):
    run = replace(make_summary("m").run, effects=(LENS,))
    RUN.write(tmp_path, run)
    draw_effects(tmp_path)
    assert not (tmp_path / "pictures").exists()  # nothing was measured
    update_costs(tmp_path, effects={"lens": 0.5}, gains={"lens": EffectGain(2.0, None, None, 4)})
    draw_effects(tmp_path)
    one = height(tmp_path)
    RUN.write(tmp_path, replace(run, effects=(LENS, replace(LENS, name="sky", on=False))))
    draw_effects(tmp_path)
    assert height(tmp_path) > one


def test_a_run_without_a_plan_gets_none(tmp_path):
    RUN.write(tmp_path, make_summary("m").run)
    update_costs(tmp_path, effects={"sky": 0.5})
    draw_effects(tmp_path)
    assert not (tmp_path / "pictures").exists()
