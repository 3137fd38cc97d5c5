"""Pictures of what effects are decided from."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sparsestreet.pictures.evidence import draw_evidence
from sparsestreet.pictures.panels import Dots, Marked, Places

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
