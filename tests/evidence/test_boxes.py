"""Trembling boxes against boxes that only move."""

import pytest
import torch

from sparsestreet.evidence.motion import box_jitter
from sparsestreet.types import Track
from tests.scene.street import pose


def car(
    *, meters: float = 0.0, degrees: float = 0.0, brake: float = 0.0, turn: float = 0.0, seed: int = 0, period=0.1
) -> Track:
    """40 boxes of a car with errors of each (meters on each axis, degrees); braking and turning."""
    draw = torch.Generator().manual_seed(seed)
    shift = meters * torch.randn(40, 3, generator=draw, dtype=torch.float64)
    times = period * torch.arange(40, dtype=torch.float64)
    ahead = 10 * times - 0.5 * brake * times**2
    yaw = turn * ahead / 10 + torch.deg2rad(degrees * torch.randn(40, generator=draw, dtype=torch.float64))
    centers = (torch.stack((ahead, turn * ahead**2 / 20, torch.zeros(40)), 1) + shift).tolist()
    poses = [pose(angle, (x, y, z)) for angle, (x, y, z) in zip(yaw.tolist(), centers, strict=True)]
    return Track("car", "Car", torch.arange(40), torch.stack(poses), torch.tensor([4.0, 2.0, 1.5]))


def test_the_value_is_the_size_of_the_errors():
    found = box_jitter([car(meters=0.02, seed=seed) for seed in range(8)], frozenset())
    assert found is not None
    # 40 boxes of each of 8 cars: a median of 300 errors an axis is good to 5 %, its least of three to a little more.
    assert found.value == pytest.approx(0.02 * 3**0.5, rel=0.12)
    assert 0 < found.error < 0.15 * found.value
    assert len(found.by_track) == 8


def test_a_turn_of_a_box_counts_by_what_it_moves():
    found = box_jitter([car(degrees=1.0, seed=seed) for seed in range(8)], frozenset())
    assert found is not None
    assert found.value == pytest.approx(torch.deg2rad(torch.tensor(1.0)).item() * (2**2 + 1**2) ** 0.5, rel=0.3)


@pytest.mark.parametrize("period", [0.1, 0.5], ids=["10 Hz", "2 Hz"])
def test_braking_and_turning_cars_do_not_tremble(period: float):
    # A quarter of the threshold of 2 cm, at 2 frames a second, too.
    found = box_jitter([car(brake=0.4, turn=0.02, period=period)], frozenset())
    assert found is not None
    assert found.value < 0.005


def test_one_stray_box_does_not_count():
    track = car(meters=0.001)
    track.world_from_object[20, 1, 3] += 5.0
    found = box_jitter([track, car(meters=0.001, seed=1)], frozenset())
    assert found is not None
    assert found.value < 0.004


def test_boxes_of_held_out_frames_are_not_looked_at():
    track = car()
    track.world_from_object[::10, 1, 3] += 5.0
    found = box_jitter([track], frozenset(range(0, 40, 10)))
    assert found is not None
    assert found.value < 1e-9


def test_few_boxes_say_nothing():
    assert box_jitter([], frozenset()) is None
    assert box_jitter([car()], frozenset(range(0, 40, 4))) is None
