"""Spots on the lens and little light, without a street: what they make of an even gray."""

from typing import Any

import numpy as np
import pytest

from sparsestreet.data.synthetic import StreetSettings
from sparsestreet.data.synthetic.capture import Sight
from sparsestreet.data.synthetic.render import at_night, behind_dirt, dirt_opacity
from sparsestreet.data.synthetic.street import street_name
from tests.typed import there

WIDTH, HEIGHT = 240, 144


def street(*, seed: int = 0, dirt: float = 0.0, night: float = 0.0) -> StreetSettings:
    return StreetSettings(width=WIDTH, height=HEIGHT, seed=seed, dirt=dirt, night=night)


def gray(level: float) -> Sight:
    return Sight(
        np.full((3, HEIGHT, WIDTH), level, np.float32),
        np.full((HEIGHT, WIDTH), 7, np.float32),
        np.zeros((HEIGHT, WIDTH), np.int16),
        np.zeros((HEIGHT, WIDTH), bool),
    )


@pytest.mark.parametrize("share", [0.01, 0.05])
def test_three_spots_cover_their_share_of_the_front_camera(share: float):
    settings = street(dirt=share)
    assert dirt_opacity(settings, 1) is None
    opacity = there(dirt_opacity(settings, 0))
    assert (opacity > 0.475).mean() == pytest.approx(share, rel=0.05)  # circles of pixels
    seen = behind_dirt(gray(0.5), opacity).linear
    assert seen.min() < 0.07
    assert seen.max() == 0.5
    assert (there(dirt_opacity(street(dirt=share, seed=1), 0)) != opacity).any()


def test_night_takes_light_and_leaves_the_noise_of_each_image():
    settings = street(night=3.0)
    first, again, other = (at_night(settings, gray(0.4), frame, 0).linear for frame in (2, 2, 3))
    assert first.mean() == pytest.approx(0.05, rel=0.01)
    assert first.std() == pytest.approx((0.002**2 + 0.01**2 * 0.05) ** 0.5, rel=0.02)
    np.testing.assert_array_equal(first, again)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.02


def test_a_clean_street_by_day_keeps_its_name():
    sight = gray(0.4)
    assert at_night(street(), sight, 0, 0) is sight
    assert dirt_opacity(street(), 0) is None
    assert street_name(street()) == street_name(street(dirt=0.0, night=0.0)) != street_name(street(dirt=0.01))


@pytest.mark.parametrize("wrong", [{"dirt": -0.1}, {"dirt": 0.2}, {"night": -1.0}])
def test_dials_have_limits(wrong: dict[str, Any]):
    with pytest.raises(ValueError, match="StreetSettings"):
        street(**wrong)
