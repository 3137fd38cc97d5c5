"""Cameras of a rig: scaled, with a lens that is simulated, left out, or taken out of the images."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from sparsestreet.data.problems import LogError
from sparsestreet.data.rig import check_lens_camera, lens_camera, rig_camera
from sparsestreet.geometry.lenses import BrownConrady, Fisheye, FTheta, Rational
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


def test_a_wide_image_through_both_doors():
    """The undistorted image does not depend on whether the same lens is called a fisheye or f-theta."""
    fisheye = Fisheye(fx=50.0, fy=50.0, cx=60.0, cy=40.0, k1=0.02)
    f_theta = FTheta(polynomial=(0.0, 50.0, 0.0, 1.0), cx=60.0, cy=40.0)
    pixels = np.random.default_rng(0).integers(0, 255, (80, 120, 3), np.uint8)
    cameras = [lens_camera("a", 0, lens=lens, recorded_size=(120, 80)) for lens in (fisheye, f_theta)]
    first, second = (there(camera.undistortion)(pixels) for camera in cameras)
    assert (first == second).all()
