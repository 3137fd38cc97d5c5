"""What a run is told about its lidar before it trusts it."""

import logging

import pytest

from sparsestreet.data.lidar import EdgeShift
from sparsestreet.training.moved_views.term import report_shift


@pytest.mark.parametrize(
    ("shift", "level", "said"),
    [
        (EdgeShift(0.9, -1.9, 900), logging.INFO, "0.9 pixels to the right of those of the lidar and -1.9 below"),
        (EdgeShift(-0.1, -2.1, 900), logging.WARNING, "-2.1 below: check calibration, poses and stamps"),
        (EdgeShift(-1.1, 0.0, 900), logging.WARNING, "-1.1 pixels to the right"),
        (None, logging.INFO, "too few edges are seen by lidar and cameras"),
    ],
)
def test_a_lidar_beside_the_images_is_warned_of(
    shift: EdgeShift | None, level: int, said: str, caplog: pytest.LogCaptureFixture
):
    with caplog.at_level(logging.INFO):
        report_shift(shift)
    assert [record.levelno for record in caplog.records] == [level]
    assert said in caplog.text
