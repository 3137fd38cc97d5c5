"""What a map and a part of an image show."""

import numpy as np
import pytest
from PIL import Image

from sparsestreet.pictures.from_above import Moving, box_in_image, draw_from_above, kinds_in_words


@pytest.mark.parametrize("middle", [(300.0, 200.0), (5.0, 395.0)], ids=["amid", "at a corner"])
def test_a_part_of_an_image_has_its_pixels_around_the_box(middle: tuple[float, float]):
    image = np.random.default_rng(0).integers(0, 255, (400, 600, 3), dtype=np.uint8)
    half = np.array([[x, y] for x in (-100, 100) for y in (-40, 40)] * 2)
    part = box_in_image(image, np.array(middle) + half, "vehicle", around=1.5)
    assert part.shape == (225, 300, 3)  # 1.5 times as wide as the box, and three quarters of that
    left, top = np.clip(np.array(middle) - (150, 113), 0, (300, 175)).astype(int)
    same = (part == image[top : top + 225, left : left + 300]).all(-1)
    assert 0.9 < same.mean() < 1.0  # but for the lines


def test_a_map_is_drawn_of_objects_and_of_none(tmp_path):
    driven = np.array([[0.0, 0, 0], [0, 30, 0]])
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 1, 3] = (0, 5, 10)
    car = Moving("found_1", "vehicle", poses, np.array([4.0, 2.0, 1.5]), np.ones((9, 3)))
    for name, objects in {"one": [car], "none": []}.items():
        draw_from_above(tmp_path / f"{name}.png", "a street", objects, np.zeros((5, 3)), driven)
        with Image.open(tmp_path / f"{name}.png") as picture:
            colors = np.asarray(picture.convert("RGB")).reshape(-1, 3)
            blue = (np.abs(colors.astype(int) - (0x00, 0x72, 0xB2)).max(-1) < 8).sum()
        assert (blue > 50) == bool(objects)


def test_kinds_are_counted_in_words():
    assert kinds_in_words({"vehicle": 3, "cyclist": 1, "pedestrian": 0}) == "3 vehicles, 1 cyclist"
    assert kinds_in_words({}) == "nothing"
