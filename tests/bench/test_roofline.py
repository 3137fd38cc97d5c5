"""Floors by hand, and that no phase of a real step is below its own."""

import pytest
import torch

from sparsestreet.bench.roofline import Floor, StepWork, floors, measured_bandwidth

WORK = StepWork(rows=10, visible=4, terms=4, samples=100, parameters=50, size=(2, 3), sky_pixels=5)


def test_bytes_by_hand():
    found = floors([WORK])
    assert found["optimizer"].bytes == 50 * 7 * 4
    # Three scales, an opacity and 4 x 3 coefficients of 10 rows, read and written.
    assert found["scene"].bytes == found["scene backward"].bytes == 2 * 10 * 16 * 4
    # 11 numbers of all rows and 12 of the four that are drawn are read; 11 + 12 + 2 of all rows are written.
    assert found["splat"].bytes == 4 * (110 + 48)
    assert found["splat backward"].bytes == 4 * (110 + 48 + 250)
    assert found["splat backward"].flops == 57 * 100
    assert found["sky"].bytes == 4 * (6 + 5 * 6)


def test_the_mean_over_steps_and_no_step():
    other = StepWork(rows=10, visible=4, terms=4, samples=None, parameters=150, size=(2, 3), sky_pixels=5)
    assert floors([other])["optimizer"].bytes == 150 * 28
    assert "splat" not in floors([other])
    assert floors([]) == {}
    assert floors([WORK, StepWork(10, 4, 4, 300, 150, (2, 3), 5)])["splat"].flops == 30 * 200


def test_the_slower_of_memory_and_arithmetic_decides():
    assert Floor(8.0, 3.0).seconds(4.0, 1.0) == pytest.approx(3.0)
    assert Floor(8.0, 1.0).seconds(4.0, 1.0) == pytest.approx(2.0)


def test_bandwidth_is_measured():
    assert 1e8 < measured_bandwidth(torch.device("cpu"), megabytes=4) < 1e13
