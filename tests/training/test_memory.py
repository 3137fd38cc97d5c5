"""Memory foreseen before a training: against what a device needed, and what is said where it is too little."""

import json
from pathlib import Path

import pytest
import torch

from sparsestreet.scene.gaussians import Rows
from sparsestreet.training import forecast
from sparsestreet.training.forecast import (
    COPIES,
    PIXEL_BYTES,
    STEP_BYTES,
    bytes_for_growth,
    bytes_of_row,
    foreseen_bytes,
    memory_problem,
)

RECORDS = Path(__file__).parents[2] / "benchmarks" / "gpu.jsonl"
COLUMNS = 59 * 4.0
"""Bytes of a Gaussian with harmonics of degree 3."""


def test_the_forecast_is_what_a_device_needed():
    """Of values and gradients, without Adam's moments, which the bench does not have. Within an eighth: an allocator
    rounds, and rows that are drawn need more than rows that are not."""
    records = [json.loads(line) for line in RECORDS.read_text().splitlines()]
    ours = [one for one in records if one.get("renderer") == "sparsestreet triton" and one["rows"] >= 1_500_000]
    assert len(ours) == 4
    for one in ours:
        pixels = one["width"] * one["height"]
        without_moments = foreseen_bytes(one["rows"], COLUMNS, pixels) - (COPIES - 2) * COLUMNS * one["rows"]
        assert without_moments == pytest.approx(1e6 * one["memory_peak"], rel=1 / 8)


def test_what_may_not_fit_is_warned_of_and_a_start_that_does_not_is_an_error():
    assert foreseen_bytes(10, 100.0, 7) == 10 * (4 * 100 + 350) + 7 * PIXEL_BYTES
    enough = foreseen_bytes(2_000, COLUMNS, 100)
    assert memory_problem(1_000, 2_000, COLUMNS, 100, enough) is None
    said = memory_problem(1_000_000, 2_000_000, COLUMNS, 100, 2e9)
    assert said == (
        "the scene may outgrow the device: 2,000,000 Gaussians and an image of 100 pixels need about 2.6 GB, and the "
        "device has 2.0 GB: lower max_gaussians of the largest nodes, or the size of the images. More processes do not "
        "help, since each holds all Gaussians"
    )
    with pytest.raises(ValueError, match=r"^1,000,000 Gaussians .* about 1.3 GB, and the device has 1.0 GB: lower"):
        memory_problem(1_000_000, 2_000_000, COLUMNS, 100, 1e9)


def test_bytes_of_a_row_are_those_of_its_columns():
    assert bytes_of_row(Rows({"means": torch.zeros(7, 3)}, {"label": torch.zeros(7, dtype=torch.int64)})) == (
        COPIES * (3 * 4 + 8) + STEP_BYTES
    )


@pytest.mark.parametrize(("free", "room"), [(1_000, 900.0), (None, float("inf"))])
def test_room_on_the_host_is_what_is_free_less_a_margin(free, room, monkeypatch):
    monkeypatch.setattr(forecast.frame_cache, "free_bytes", lambda: free)
    assert bytes_for_growth(torch.device("cpu")) == pytest.approx(room)


def test_room_on_a_device_is_what_its_peak_left(monkeypatch):
    """Of 100 bytes 30 are free and 60 torch's, which needed 50 at once."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (30, 100))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 60)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: 50)
    assert bytes_for_growth(torch.device("cuda", 0)) == pytest.approx(0.9 * 40)
