"""Pictures: their colors, and what is written to disk."""

import matplotlib
import numpy as np
import pytest

from sparsestreet.pictures.images import (
    ERROR_SCALE,
    LIDAR_END,
    color_map,
    draw_lidar_end,
    error_picture,
    picture_path,
    read_pictures,
    write_picture,
    write_png,
)
from tests.evaluation.tiles import flat, make_picture


def test_error_is_the_mean_absolute_difference_on_the_common_scale():
    truth, render = flat((100, 100, 100)), flat((100, 100, 100))
    render[0, 0] = (70, 130, 100)  # 20 levels on average, in either direction
    render[0, 1] = (255, 255, 255)
    picture = error_picture(render, truth)
    assert tuple(picture[5, 5]) == tuple(color_map(np.array([0.0]))[0])
    assert tuple(picture[0, 0]) == tuple(color_map(np.array([20 / 255 / ERROR_SCALE]))[0])
    assert tuple(picture[0, 1]) == tuple(color_map(np.array([1.0]))[0])
    assert (error_picture(truth, render) == picture).all()


def line_of(picture: np.ndarray) -> np.ndarray:
    return (picture == LIDAR_END).all(-1)


def test_the_line_is_where_near_pixels_touch_one_beyond():
    """Near below row 4, and in one pixel above it; the sky, of neither region, begins in column 9."""
    near, beyond, expected = (np.zeros((9, 13), dtype=bool) for _ in range(3))
    near[4:], beyond[:4], near[1, 4], beyond[1, 4] = True, True, True, False
    near[:, 9:] = beyond[:, 9:] = False
    expected[4, :9] = expected[1, 4] = True
    picture = flat((10, 20, 30), 9, 13)
    drawn = draw_lidar_end(picture, near, beyond)
    assert (line_of(drawn) == expected).all()
    assert (drawn[~expected] == picture[~expected]).all()
    assert not line_of(picture).any()
    assert not line_of(draw_lidar_end(picture, ~beyond & ~near, beyond & False)).any()


def test_the_line_of_a_large_image_is_seen_on_a_sheet():
    near = np.repeat(np.arange(10)[:, None] >= 6, 1440, axis=1)
    drawn = line_of(draw_lidar_end(flat((10, 20, 30), 10, 1440), near, ~near))
    assert drawn.all(1).tolist() == 6 * [False] + 3 * [True] + [False]  # three pixels become one of 480
    assert drawn.sum() == 3 * 1440


def test_pictures_on_disk_round_trip(tmp_path):
    pictures = [make_picture(12, 0), make_picture(3, 1), make_picture(3, 0)]
    pictures[0].error[4] = LIDAR_END
    for picture in pictures:
        write_picture(tmp_path, picture)
    assert (tmp_path / "003_1_error.png").exists()
    assert len(list(tmp_path.iterdir())) == 12
    found = read_pictures(tmp_path)
    assert [(picture.frame, picture.camera) for picture in found] == [(3, 0), (3, 1), (12, 0)]
    assert (found[2].render == pictures[0].render).all()
    assert (found[2].error == pictures[0].error).all()
    assert (found[2].centers == pictures[0].centers).all()
    assert [picture.shows_lidar_end for picture in found] == [False, False, True]


def test_missing_pictures_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="has no pictures"):
        read_pictures(tmp_path)
    write_png(picture_path(tmp_path, 3, 1, "truth"), flat((1, 2, 3)))
    with pytest.raises(FileNotFoundError, match="003_1_render"):
        read_pictures(tmp_path)


def test_the_knots_of_the_map_are_infernos():
    """Between two of them colors lie on a straight line."""
    knots = np.linspace(0, 1, 17)
    expected = (matplotlib.colormaps["inferno"](knots)[:, :3] * 255).round()
    assert color_map(knots).tolist() == expected.tolist()
    between = color_map(knots[:-1] + 1 / 32).astype(float)
    assert np.abs(between - (expected[:-1] + expected[1:]) / 2).max() <= 0.5
