"""Sheets: what is where, in which colours, and what is written to disk."""

import matplotlib
import numpy as np
import pytest
from PIL import Image

from sparsestreet.evaluation.compare import compare_runs
from sparsestreet.evaluation.pictures import (
    ERROR_SCALE,
    Picture,
    colour_map,
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

COLOURS = {"truth": (200, 10, 10), "render": (10, 200, 10), "centres": (10, 10, 200)}


def flat(colour: tuple[int, int, int], height: int = 9, width: int = 13) -> np.ndarray:
    return np.full((height, width, 3), colour, dtype=np.uint8)


def make_picture(frame: int = 3, camera: int = 1, render: tuple[int, int, int] = COLOURS["render"]) -> Picture:
    return Picture(frame, camera, flat(COLOURS["truth"]), flat(render), flat(COLOURS["centres"]))


def order_of(sheet: np.ndarray, row: int) -> list[tuple[int, int, int]]:
    """Colours met along a row of pixels, without repeats and without the paper between tiles."""
    paper = tuple(int(value) for value in sheet[-1, -1])
    colours = [tuple(int(value) for value in pixel) for pixel in sheet[row]]
    met = [colour for index, colour in enumerate(colours) if index == 0 or colour != colours[index - 1]]
    return [colour for colour in met if colour != paper]


def row_within(sheet: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Middle row of the rows in which a colour fills a tile."""
    rows = np.flatnonzero((sheet == colour).all(-1).sum(1) >= 100)
    return int(rows[len(rows) // 2])


def test_colour_map_is_inferno():
    values = np.linspace(-0.2, 1.2, 301)
    expected = matplotlib.colormaps["inferno"](np.clip(values, 0, 1))[:, :3] * 255
    # 17 samples joined by straight lines cut the corner of blue near 0.8 by 7 of 255 levels, less elsewhere.
    assert np.abs(colour_map(values).astype(float) - expected).max() <= 7.5
    luminance = colour_map(np.linspace(0, 1, 50)) @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(luminance) > 0).all()


def test_error_is_the_mean_absolute_difference_on_the_common_scale():
    truth, render = flat((100, 100, 100)), flat((100, 100, 100))
    render[0, 0] = (70, 130, 100)  # 20 levels on average, in either direction
    render[0, 1] = (255, 255, 255)
    picture = error_picture(render, truth)
    assert tuple(picture[5, 5]) == tuple(colour_map(np.array([0.0]))[0])
    assert tuple(picture[0, 0]) == tuple(colour_map(np.array([20 / 255 / ERROR_SCALE]))[0])
    assert tuple(picture[0, 1]) == tuple(colour_map(np.array([1.0]))[0])
    assert (error_picture(truth, render) == picture).all()


def test_sheet_columns_are_truth_render_error_centres():
    sheet = picture_sheet([make_picture()], title="a title", tile_width=120)
    error = tuple(int(value) for value in make_picture().error[0, 0])
    expected = [COLOURS["truth"], COLOURS["render"], error, COLOURS["centres"]]
    assert order_of(sheet, row_within(sheet, COLOURS["truth"])) == expected


def test_images_of_several_sizes_share_a_sheet():
    tall = Picture(4, 0, flat(COLOURS["truth"], 40), flat(COLOURS["render"], 40), flat(COLOURS["centres"], 40))
    one = picture_sheet([make_picture()], title="t", tile_width=120)
    both = picture_sheet([make_picture(), tall], title="t", tile_width=120)
    assert both.shape[1] == one.shape[1]
    assert both.shape[0] > one.shape[0] + 40 * 120 // 13
    with pytest.raises(ValueError, match="at least one picture"):
        picture_sheet([], title="t")


def test_comparison_sets_the_runs_below_each_other():
    ours_colour = (60, 180, 60)
    plain, ours = make_picture(), make_picture(render=ours_colour)
    sheet = compare([plain], [ours])
    upper, lower = row_within(sheet, COLOURS["render"]), row_within(sheet, ours_colour)
    errors = [tuple(int(value) for value in picture.error[0, 0]) for picture in (plain, ours)]
    assert upper < lower
    assert order_of(sheet, upper) == [COLOURS["truth"], COLOURS["render"], errors[0], COLOURS["centres"]]
    assert order_of(sheet, lower) == [ours_colour, errors[1], COLOURS["centres"]]
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
    assert (found[2].centres == pictures[0].centres).all()


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
