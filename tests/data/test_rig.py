"""Cameras of a rig: scaled, with a lens that is simulated, left out, or taken out of the images."""

import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sparsestreet.data.problems import LogError
from sparsestreet.data.rig import Undistortion, check_lens_camera, lens_camera, rig_camera
from sparsestreet.geometry.lenses import BrownConrady, Fisheye, FTheta, Lens, Mei, Rational, undistort
from tests.typed import there

FOCAL = {"fx": 200.0, "fy": 210.0, "cx": 60.0, "cy": 40.0}
BARREL = {"k1": -0.2, "k2": 0.02, "p1": 1e-3, "p2": -1e-3, "k3": 0.0}


def test_a_scaled_image_keeps_a_row():
    """100 x 3 pixels to a width of 10: 0.3 rows are one, and a pixel is 10 wide and 3 high."""
    intrinsics = torch.tensor([[200.0, 0, 50], [0, 200, 1.5], [0, 0, 1]], dtype=torch.float64)
    lens = torch.zeros(5, dtype=torch.float64)
    camera = rig_camera("front", 0, intrinsics=intrinsics, distortion=lens, recorded_size=(100, 3), width=10)
    assert camera.size == (10, 1)
    expected = torch.tensor([[20.0, 0, 5], [0, 200 / 3, 0.5], [0, 0, 1]])
    torch.testing.assert_close(camera.intrinsics, expected)


@pytest.mark.parametrize("lens", [BrownConrady(**FOCAL, **BARREL), Rational(**FOCAL, **BARREL)], ids=["brown", "eight"])
def test_brown_conrady_is_kept_however_it_is_written(lens):
    size, width = (120, 80), 60
    camera = lens_camera("a", 3, lens=lens, recorded_size=size, width=width)
    intrinsics, numbers = lens.pinhole, torch.tensor([*BARREL.values()], dtype=torch.float64)
    same = rig_camera(
        "a",
        3,
        intrinsics=intrinsics,
        distortion=numbers,
        recorded_size=size,
        width=width,
    )
    assert (camera.index, camera.size, camera.note) == (3, (60, 40), same.note)
    assert torch.equal(camera.intrinsics, same.intrinsics)
    assert camera.undistortion is None
    assert torch.equal(there(camera.distortion), numbers.float())


def test_another_lens_is_taken_out_at_the_resolution_of_its_center():
    lens = Fisheye(**FOCAL, k1=-0.05)
    camera = lens_camera("wide", 0, lens=lens, recorded_size=(120, 80), width=60)
    take_out = there(camera.undistortion)
    assert (camera.size, camera.distortion) == ((60, 40), None)
    assert camera.intrinsics.tolist() == [[100, 0, 30], [0, 105, 20], [0, 0, 1]]
    assert take_out.columns.shape == (40, 60)
    # The corner of the pinhole is 0.36 rad outside, which the lens images nearer to the center.
    assert take_out.columns[0, 0] > 0.3
    assert take_out.blank is None
    note = there(camera.note)
    degrees = round(2 * math.degrees(math.atan(60 / 200)))
    assert note.startswith("camera wide: its lens (Fisheye) is none that is simulated; its images are resampled to a ")
    assert f"pinhole of {degrees} degrees, outside of which lie {take_out.lost:.1%} of the recorded pixels" in note
    assert "nothing was recorded for 0.0% of its own" in note
    assert 0.01 < take_out.lost < 0.1


def test_the_pinhole_may_keep_a_field_of_view():
    lens = FTheta(polynomial=(0.0, 50.0), cx=61.0, cy=40.0, linear=(1.1, 0.0, 0.0))
    camera = lens_camera("wide", 0, lens=lens, recorded_size=(120, 80), pinhole_fov=120.0)
    focal = 60 / math.tan(math.radians(60))
    expected = torch.tensor([[focal, 0, 60], [0, focal / 1.1, 40], [0, 0, 1]])
    torch.testing.assert_close(camera.intrinsics, expected)
    blank = there(there(camera.undistortion).blank)
    share = float(blank.double().mean())
    assert share > 0.05
    assert "pinhole of 120 degrees" in there(camera.note)
    assert f"nothing was recorded for {share:.1%} of its own" in there(camera.note)
    for degrees in (0.0, 170.0, math.nan):
        with pytest.raises(ValueError, match="pinhole_fov must lie within 0 and 170 degrees"):
            lens_camera("wide", 0, lens=lens, recorded_size=(120, 80), pinhole_fov=degrees)
    with pytest.raises(ValueError, match="width must be within 1 to 120"):
        lens_camera("wide", 0, lens=lens, recorded_size=(120, 80), width=121)


@pytest.mark.parametrize(("k1", "is_left_out"), [(0.3, True), (0.5, False)])
def test_images_are_not_resampled_for_a_lens_that_moves_nothing(k1, is_left_out):
    """The corner lies at r = 0.355, 72 pixels from the center. It moves by r^2 (k1 - k4) of them: 9 for 0.2."""
    lens = Rational(**FOCAL, k1=k1, k4=0.3001)
    camera = lens_camera("a", 0, lens=lens, recorded_size=(120, 80))
    assert (camera.undistortion is None) == is_left_out
    said = re.fullmatch(
        r"camera a: its lens \(Rational\) moves pixels by at most \S+ and is left out", there(camera.note)
    )
    assert (said is not None) == is_left_out


def test_a_lens_without_an_inverse_is_refused():
    path = Path("calibration.json")
    for lens in (Rational(**FOCAL, k1=-9.0, k4=1e-9), BrownConrady(**FOCAL, p1=-9.0, p2=9.0)):
        with pytest.raises(LogError, match=r"calibration\.json: .*; write the coefficients of the calibration"):
            check_lens_camera(path, lens, (120, 80))
    check_lens_camera(path, BrownConrady(**FOCAL, **BARREL), (120, 80))
    check_lens_camera(path, Fisheye(**FOCAL, k1=-0.05), (120, 80))


WIDTH, HEIGHT = 60, 40
INTRINSICS = torch.tensor([[50.0, 0.0, 31.0], [0.0, 55.0, 18.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
LENSES = {"barrel": [-0.3, 0.1, 2e-3, -1e-3, -0.01], "pincushion": [0.2, 0.05, -1e-3, 2e-3, 0.0]}


def taken_out(distortion: torch.Tensor) -> Undistortion:
    """Brown-Conrady's lens, for the pinhole with the same intrinsics."""
    size = (WIDTH, HEIGHT)
    return Undistortion.of(BrownConrady.of(INTRINSICS, distortion), INTRINSICS, size, size)


def slopes() -> torch.Tensor:
    """x / z and y / z of the pixel centers of a pinhole [h, w, 2]."""
    column, row = torch.meshgrid(torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5, indexing="xy")
    center, focal = INTRINSICS[:2, 2], INTRINSICS.diagonal()[:2]
    return (torch.stack((column, row), -1).double() - center) / focal


def light(slopes: torch.Tensor) -> np.ndarray:
    """What comes from a direction: gentle slopes, so that bilinear interpolation of counts is right to one of them."""
    x, y = slopes.unbind(-1)
    return torch.stack((128 + 150 * x, 128 + 180 * y, 128 + 60 * x * y), -1).clamp(0, 255).round().byte().numpy()


def inside(lens: str) -> np.ndarray:
    """Pixels that the recorded image surrounds: a pixel from its border the light comes from outside of it too."""
    map_of = taken_out(torch.tensor(LENSES[lens], dtype=torch.float64))
    in_columns = (map_of.columns >= 0) & (map_of.columns <= WIDTH - 1)
    return in_columns & (map_of.rows >= 0) & (map_of.rows <= HEIGHT - 1)


@pytest.mark.parametrize("lens", LENSES)
def test_opencv_does_the_same(lens):
    """Its pixel centers are whole numbers, so its principal point lies half a pixel nearer to the corner."""
    distortion = torch.tensor(LENSES[lens], dtype=torch.float64)
    recorded = light(undistort(slopes(), distortion))
    shifted = INTRINSICS.clone()
    shifted[:2, 2] -= 0.5
    expected = cv2.undistort(recorded, shifted.numpy(), distortion.numpy())
    seen = taken_out(distortion)(recorded)
    # It rounds places to a 32nd of a pixel, where colors change by 3 counts a pixel; at the border they fall to 0.
    known = inside(lens)
    assert np.abs(seen.astype(int) - expected)[known].max() <= 1
    # What a pinhole records, and what the lens did; both are rounded to counts.
    assert np.abs(seen.astype(int) - light(slopes()))[known].max() <= 1
    assert np.abs(recorded.astype(int) - light(slopes()))[known].max() > 5
    assert known.mean() > 0.7


def test_a_mask_keeps_every_pixel_that_the_object_touches():
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:20, 20:40] = 255
    distortion = torch.tensor(LENSES["barrel"], dtype=torch.float64)
    map_of = taken_out(distortion)
    seen, (columns, rows) = map_of(mask) > 0, (map_of.columns, map_of.rows)

    def within(margin: float) -> np.ndarray:
        """Places less than so many pixels from the center of a pixel of the mask."""
        return (np.abs(columns - 29.5) < 9.5 + margin) & (np.abs(rows - 14.5) < 4.5 + margin)

    # Bilinear weights are above 0 up to a pixel away; OpenCV rounds places to a 32nd of one, and loses half a count.
    assert not (seen & ~within(1 + 1 / 32)).any()
    assert not (within(1 - 2 / 32) & ~seen).any()
    assert within(1.0).sum() > within(0.5).sum() + 20


FISHEYES: dict[str, Lens] = {
    "fisheye": Fisheye(fx=30.0, fy=31.0, cx=31.0, cy=18.5, k1=-0.03, k2=0.01),
    "mei": Mei(xi=1.8, gamma1=84.0, gamma2=86.8, u0=31.0, v0=18.5, k1=0.02, k2=0.5, p1=1e-3),
    "f_theta": FTheta(polynomial=(0.0, 30.0, 0.0, -1.0), cx=31.0, cy=18.5, linear=(1.0, 0.01, -0.01), max_angle=1.2),
}
"""Of wide images, whose light is too far outside for slopes: it comes by angle."""


def directions_shown(lens: Lens, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Directions that a lens images at some places, by a search on a grid and Newton's method on differences."""
    span = torch.linspace(-1.2, 1.2, 61, dtype=torch.float64)
    x, y = torch.meshgrid(torch.tan(span), torch.tan(span), indexing="xy")
    grid = torch.stack((x, y, torch.ones_like(x)), -1).reshape(-1, 3)
    pixels = lens.project(grid)
    wanted = torch.from_numpy(np.stack((columns.ravel(), rows.ravel()), -1)).double()
    distances = torch.cdist(wanted, torch.nan_to_num(pixels, nan=1e9))
    at = grid[distances.argmin(1), :2]
    for _ in range(8):
        value, steps = _image(lens, at), 1e-6 * torch.eye(2, dtype=torch.float64)
        jacobian = torch.stack([(_image(lens, at + step) - value) / 1e-6 for step in steps], -1)
        at = at - torch.linalg.solve(jacobian, (value - wanted)[..., None])[..., 0]
    return at.numpy().reshape(*columns.shape, 2)


def _image(lens: Lens, slopes: torch.Tensor) -> torch.Tensor:
    return lens.image(torch.cat((slopes, torch.ones(len(slopes), 1)), 1))


@pytest.mark.parametrize("lens", FISHEYES.values(), ids=FISHEYES.keys())
def test_what_a_fisheye_recorded_becomes_what_a_pinhole_records(lens):
    """The fisheye's image is made from the directions of its own pixels, which the undistortion never asks for."""
    lens.check(WIDTH, HEIGHT)
    columns, rows = np.meshgrid(np.arange(4, WIDTH - 4) + 0.5, np.arange(4, HEIGHT - 4) + 0.5)
    recorded = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    recorded[4:-4, 4:-4] = light(torch.from_numpy(directions_shown(lens, columns, rows)))
    take_out = Undistortion.of(lens, INTRINSICS, (WIDTH, HEIGHT), (WIDTH, HEIGHT))
    seen = take_out(recorded).astype(int)
    known = (np.abs(take_out.columns - 29.5) < 25.4) & (np.abs(take_out.rows - 19.5) < 15.4)
    assert known.mean() > 0.9
    # Light bends between wide pixels, and is cut to counts.
    unclipped = (seen[known] > 0).all(1) & (seen[known] < 255).all(1)
    assert np.abs(seen - light(slopes()))[known][unclipped].max() <= 3
    assert unclipped.mean() > 0.9


def test_images_of_another_size_than_the_calibration():
    """A fisheye of twice the pixels: its places are those of half the image."""
    lens = FISHEYES["fisheye"]
    twice = Fisheye(fx=60.0, fy=62.0, cx=62.0, cy=37.0, k1=-0.03, k2=0.01)
    small = Undistortion.of(lens, INTRINSICS, (WIDTH, HEIGHT), (WIDTH, HEIGHT))
    scaled = Undistortion.of(twice, INTRINSICS, (WIDTH, HEIGHT), (2 * WIDTH, 2 * HEIGHT))
    np.testing.assert_allclose(scaled.columns, small.columns, atol=1e-4)
    np.testing.assert_allclose(scaled.rows, small.rows, atol=1e-4)


def plain(focal: float, **changes: float) -> Undistortion:
    """A pinhole that is looked at through another one, 100 x 80 pixels."""
    lens = BrownConrady(**{"fx": 100.0, "fy": 100.0, "cx": 50.0, "cy": 40.0} | changes)
    intrinsics = torch.tensor([[focal, 0, 50], [0, focal, 40], [0, 0, 1]], dtype=torch.float64)
    return Undistortion.of(lens, intrinsics, (100, 80), (100, 80))


def test_what_is_lost_and_what_is_blank():
    same = plain(100.0)
    assert same.blank is None
    assert same.lost == pytest.approx(0, abs=1e-6)
    assert same.largest_shift == pytest.approx(0, abs=1e-5)
    zoomed = plain(200.0)  # sees the middle 50 x 40 pixels
    assert zoomed.blank is None
    assert zoomed.lost == pytest.approx(0.75, abs=1e-6)
    assert zoomed.largest_shift == pytest.approx(math.hypot(49.5, 39.5) / 2, rel=1e-6)
    wide = plain(50.0)  # sees four times the image: what is recorded fills its middle
    assert wide.lost == pytest.approx(0, abs=1e-6)
    blank = there(wide.blank)
    # Centers of pixels 25 and 74 lie at 0.5 and 98.5 of the recorded centers 0 .. 99.
    assert not blank[20:60, 25:75].any()
    assert int(blank.sum()) == 100 * 80 - 50 * 40
    shifted = plain(100.0, cx=50.25)
    assert int(there(shifted.blank).sum()) == 80  # the last column mixes with black
    assert shifted.lost == pytest.approx(0.0, abs=0.01)


def test_beyond_the_reach_of_a_lens_nothing_is_shown():
    lens = FTheta(polynomial=(0.0, 40.0), cx=31.0, cy=18.5, max_angle=0.4)
    take_out = Undistortion.of(lens, INTRINSICS, (WIDTH, HEIGHT), (WIDTH, HEIGHT))
    beyond = slopes().norm(dim=-1).numpy() > math.tan(0.4)
    assert (there(take_out.blank).numpy() == beyond).all()
    assert (take_out(np.full((HEIGHT, WIDTH), 255, np.uint8))[beyond] == 0).all()
    # A circle of 16 pixels is shown; the area of its outermost pixels is not known.
    assert take_out.lost == pytest.approx(
        1 - math.pi * 16**2 / (WIDTH * HEIGHT), abs=2 * math.pi * 16 / (WIDTH * HEIGHT)
    )
