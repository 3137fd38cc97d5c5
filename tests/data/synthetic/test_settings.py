"""Streets and sensors that cannot be are refused; equal values are equal settings, however they were written."""

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from sparsestreet.data.synthetic.settings import WAYMO_TOP, StreetSettings
from tests.conftest import unchecked

POSITIVE = ("num_frames", "width", "height", "supersampling", "frame_rate", "ego_speed", "annotation_range")
NOT_NEGATIVE = (
    "seed", "num_parked_cars", "num_moving_cars", "num_pedestrians", "num_crossing", "num_cyclists", "body_pose_noise",
    "exposure_walk", "white_balance", "readout", "shutter_time", "hood", "dirt", "night", "turn",
)  # fmt: skip
DELAYS = "delays must be empty or one for each of 2 cameras, shorter than a frame of 0.5 s, but is ["


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        *(({name: 0}, f"{name} must be positive but is 0") for name in POSITIVE),
        *(({name: -1}, f"{name} must not be negative but is -1") for name in NOT_NEGATIVE),
        ({"num_cameras": 4}, "num_cameras must be 1, 2 or 3 but is 4"),
        ({"field_of_view": 170.0}, "field_of_view must lie in [10, 120] degrees but is 170.0"),
        ({"limp": 1.5}, "limp must be a share from 0 to 1 but is 1.5"),
        ({"jpeg": 0}, "jpeg must be a quality from 1 to 100 but is 0"),
        ({"jpeg": 101}, "jpeg must be a quality from 1 to 100 but is 101"),
        ({"hood": 0.6}, "hood must be a share of the image up to 0.5 but is 0.6"),
        ({"hood_cameras": "left"}, "hood_cameras must be front or all but is left"),
        ({"dirt": 0.2}, "dirt must be a share of the image up to 0.1 but is 0.2"),
        ({"white_balance": 0.1, "num_cameras": 1}, "white_balance needs two cameras"),
        ({"readout": 0.5}, "readout must be shorter than a frame of 0.5 s but is 0.5"),
        ({"shutter_time": 0.5}, "shutter_time must be shorter than a frame of 0.5 s but is 0.5"),
        ({"readout_direction": "up"}, "readout_direction must be one of top, bottom, left, right but is up"),
        (
            {"turn": 15.0, "ego_speed": 15.0},
            "turn must keep the car within 1.75 m of its lane's middle, but 15 degrees at 15 m/s take it 2.56 m off",
        ),
        *(({"delays": values}, DELAYS) for values in ((0.1,), (0.1, 0.2, 0.3), (0.0, 0.5), (0.0, math.nan))),
        *(
            ({name: values}, f"{name} must be empty or [meters, degrees] but is [")
            for name in ("pose_noise", "box_noise")
            for values in ((0.1,), (0.1, 0.2, 0.3), (-0.1, 0.0), (0.1, math.nan))
        ),
    ],
    ids=str,
)
def test_a_street_that_cannot_be(wrong, said):
    with unchecked(), pytest.raises(ValueError, match=r"StreetSettings\.") as caught:
        replace(StreetSettings(num_cameras=2, frame_rate=2.0), **wrong)
    assert f"StreetSettings.{said}" in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("beams", 0),
        ("azimuth_steps", -3),
        ("max_range", 0.0),
        ("height", -1.0),
        ("noise", -0.1),
        ("noise", math.nan),
        ("dropout", 1.0),
        ("dropout", -0.1),
        *(("elevations", ends) for ends in ([3.0, 2.0], [-90.0, 2.0], [-9.0, 90.0], [1.0], [1.0, 2.0, 3.0])),
    ],
)
def test_a_sensor_that_cannot_be(field, value):
    with pytest.raises(ValueError, match=rf"LidarSensor\.{field} ") as caught:
        replace(WAYMO_TOP, **{field: value})
    assert str(value) in str(caught.value)


@pytest.mark.parametrize(
    "lens",
    [
        (-0.3, 0.1, 0.0, 0.0),
        (math.nan, 0.1, 0.0, 0.0, 0.0),
        (-0.3, 0.1, 0.0, math.inf, 0.0),
        # Folds at r = 0.75, which it images at 0.50: the image's corner lies at 0.69.
        (-0.6, 0.0, 0.0, 0.0, 0.0),
        # Images nothing left of x = -1 / 6.
        (0.0, 0.0, 0.0, 0.5, 0.0),
    ],
)
def test_a_lens_that_does_not_reach_the_corners(lens):
    with pytest.raises(ValueError, match=r"five coefficients k1, k2, p1, p2, k3 .* in the whole image but is \["):
        StreetSettings(lens=lens)


@pytest.mark.parametrize(("excess", "reaches"), [(-2e-8, True), (2e-8, False)])
def test_the_largest_lens_is_found_in_float64(excess, reaches):
    """r (1 + k r^2) is largest, 2/3 r, at r^2 = -1 / 3k: the corner c of an image is reached up to k = -4 / 27 c^2.

    Coefficients rounded to float32 are off by up to 6e-8 of their size.
    """
    corner_squared = np.tan(np.radians(30)) ** 2 * (1 + 0.75**2)
    lens = (-4 / 27 / corner_squared * (1 + excess), 0.0, 0.0, 0.0, 0.0)
    with nullcontext() if reaches else pytest.raises(ValueError, match="in the whole image"):
        StreetSettings(width=80, height=60, field_of_view=60.0, lens=lens)


def test_equal_values_are_equal_settings():
    """As a file gives them, and as code does."""
    from_file = StreetSettings(
        lens=[-0.3, 0.1, 0, 0, 0], delays=[0, 0.01, 0], pose_noise=[1, 2], box_noise=[0, 1],
        lidar=replace(WAYMO_TOP, elevations=[-30.0, 20.0]),
    )  # fmt: skip
    from_code = StreetSettings(
        lens=(-0.3, 0.1, 0.0, 0.0, 0.0), delays=(0.0, 0.01, 0.0), pose_noise=(1.0, 2.0), box_noise=(0.0, 1.0),
        lidar=replace(WAYMO_TOP, elevations=(-30.0, 20.0)),
    )  # fmt: skip
    assert from_file == from_code
    assert hash(from_file) == hash(from_code)
