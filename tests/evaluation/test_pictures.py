"""Sheets: what is where, in which colors, and what is written to disk."""

import matplotlib
import numpy as np
import pytest
from PIL import Image

from sparsestreet.evaluation.compare import compare_runs
from sparsestreet.evaluation.pictures import (
    ERROR_SCALE,
    Picture,
    color_map,
    comparison_sheet,
    error_picture,
    picture_path,
    picture_sheet,
    read_pictures,
    write_picture,
    write_png,
)
from sparsestreet.evaluation.records import summary_path, write_summary
from tests.evaluation.frames import make_summary

COLORS = {"truth": (200, 10, 10), "render": (10, 200, 10), "centers": (10, 10, 200)}


def flat(color: tuple[int, int, int], height: int = 9, width: int = 13) -> np.ndarray:
    return np.full((height, width, 3), color, dtype=np.uint8)


def make_picture(frame: int = 3, camera: int = 1, render: tuple[int, int, int] = COLORS["render"]) -> Picture:
    return Picture(frame, camera, flat(COLORS["truth"]), flat(render), flat(COLORS["centers"]))


def order_of(sheet: np.ndarray, row: int) -> list[tuple[int, int, int]]:
    """Colors met along a row of pixels, without repeats and without the paper between tiles."""
    paper = tuple(int(value) for value in sheet[-1, -1])
    colors = [tuple(int(value) for value in pixel) for pixel in sheet[row]]
    met = [color for index, color in enumerate(colors) if index == 0 or color != colors[index - 1]]
    return [color for color in met if color != paper]


def row_within(sheet: np.ndarray, color: tuple[int, int, int]) -> int:
    """Middle row of the rows in which a color fills a tile."""
    rows = np.flatnonzero((sheet == color).all(-1).sum(1) >= 100)
    return int(rows[len(rows) // 2])


def test_color_map_is_inferno():
    values = np.linspace(-0.2, 1.2, 301)
    expected = matplotlib.colormaps["inferno"](np.clip(values, 0, 1))[:, :3] * 255
    # 17 samples joined by straight lines cut the corner of blue near 0.8 by 7 of 255 levels, less elsewhere.
    assert np.abs(color_map(values).astype(float) - expected).max() <= 7.5
    luminance = color_map(np.linspace(0, 1, 50)) @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(luminance) > 0).all()


def test_error_is_the_mean_absolute_difference_on_the_common_scale():
    truth, render = flat((100, 100, 100)), flat((100, 100, 100))
    render[0, 0] = (70, 130, 100)  # 20 levels on average, in either direction
    render[0, 1] = (255, 255, 255)
    picture = error_picture(render, truth)
    assert tuple(picture[5, 5]) == tuple(color_map(np.array([0.0]))[0])
    assert tuple(picture[0, 0]) == tuple(color_map(np.array([20 / 255 / ERROR_SCALE]))[0])
    assert tuple(picture[0, 1]) == tuple(color_map(np.array([1.0]))[0])
    assert (error_picture(truth, render) == picture).all()


def test_sheet_columns_are_truth_render_error_centers():
    sheet = picture_sheet([make_picture()], title="a title", tile_width=120)
    error = tuple(int(value) for value in make_picture().error[0, 0])
    expected = [COLORS["truth"], COLORS["render"], error, COLORS["centers"]]
    assert order_of(sheet, row_within(sheet, COLORS["truth"])) == expected


def test_images_of_several_sizes_share_a_sheet():
    tall = Picture(4, 0, flat(COLORS["truth"], 40), flat(COLORS["render"], 40), flat(COLORS["centers"], 40))
    one = picture_sheet([make_picture()], title="t", tile_width=120)
    both = picture_sheet([make_picture(), tall], title="t", tile_width=120)
    assert both.shape[1] == one.shape[1]
    assert both.shape[0] > one.shape[0] + 40 * 120 // 13
    with pytest.raises(ValueError, match="at least one picture"):
        picture_sheet([], title="t")


def test_comparison_sets_the_runs_below_each_other():
    ours_color = (60, 180, 60)
    plain, ours = make_picture(), make_picture(render=ours_color)
    sheet = compare([plain], [ours])
    upper, lower = row_within(sheet, COLORS["render"]), row_within(sheet, ours_color)
    errors = [tuple(int(value) for value in picture.error[0, 0]) for picture in (plain, ours)]
    assert upper < lower
    assert order_of(sheet, upper) == [COLORS["truth"], COLORS["render"], errors[0], COLORS["centers"]]
    assert order_of(sheet, lower) == [ours_color, errors[1], COLORS["centers"]]
    with pytest.raises(ValueError, match=r"different images, \(frame, camera\) \[\(3, 1\)\] and \[\(4, 1\)\]"):
        compare([plain], [make_picture(4)])


def compare(plain, ours):
    labels = {"plain_label": "plain", "ours_label": "ours", "plain_count": 100, "ours_count": 33}
    return comparison_sheet(plain, ours, **labels, title="t", legend={"rigid": (250, 150, 40)}, tile_width=120)


def test_counts_and_legend_are_drawn():
    with_legend = compare([make_picture()], [make_picture()])
    assert (with_legend == (250, 150, 40)).all(-1).sum() >= 100
    more = comparison_sheet(
        [make_picture()],
        [make_picture()],
        plain_label="plain",
        ours_label="ours",
        plain_count=100,
        ours_count=44,
        title="t",
        legend={"rigid": (250, 150, 40)},
        tile_width=120,
    )
    assert (more != with_legend).any()


def test_pictures_on_disk_round_trip(tmp_path):
    pictures = [make_picture(12, 0), make_picture(3, 1), make_picture(3, 0)]
    for picture in pictures:
        write_picture(tmp_path, picture)
    assert (tmp_path / "003_1_error.png").exists()
    assert len(list(tmp_path.iterdir())) == 12
    found = read_pictures(tmp_path)
    assert [(picture.frame, picture.camera) for picture in found] == [(3, 0), (3, 1), (12, 0)]
    assert (found[2].render == pictures[0].render).all()
    assert (found[2].centers == pictures[0].centers).all()


def test_missing_pictures_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="has no pictures"):
        read_pictures(tmp_path)
    write_png(picture_path(tmp_path, 3, 1, "truth"), flat((1, 2, 3)))
    with pytest.raises(FileNotFoundError, match="003_1_render"):
        read_pictures(tmp_path)


def test_two_run_folders_make_a_sheet(tmp_path):
    for name, scene in (("plain", "street"), ("ours", "street"), ("other", "kitti")):
        write_summary(summary_path(tmp_path / name), make_summary(name, scene=scene))
        write_picture(tmp_path / name / "pictures", make_picture())
    compare_runs(tmp_path / "plain", tmp_path / "ours", tmp_path / "sheets" / "comparison.png")
    with Image.open(tmp_path / "sheets" / "comparison.png") as image:
        assert image.width > 4 * 480
    with pytest.raises(ValueError, match="compare one scene"):
        compare_runs(tmp_path / "plain", tmp_path / "other", tmp_path / "no.png")
