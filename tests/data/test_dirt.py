"""Spots on a lens are found where returns of the lidar pass behind them, and only there."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.hood import find_dirt
from sparsestreet.data.lazy import Frames, Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.scene.effects import DirtSettings
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.types import Sweep
from tests.evidence import wall

INSTANTS = 40
"""24 m of driving."""
SPOT = torch.zeros(wall.HEIGHT, wall.WIDTH, dtype=torch.bool)
SPOT[12:18, 30:37] = True


def frames(opacity: float = 0.95, spot: torch.Tensor = SPOT) -> Frames:
    """The first of two cameras sees the wall through a dark spot."""
    made = []
    for instant in range(INSTANTS):
        for number in (0, 1):
            frame = wall.frame(instant, number, torch.full((3,), 1.5))
            dirty = torch.where(spot[..., None], (1 - opacity) * frame.image + opacity * 20, frame.image).byte()
            made.append(replace(frame, image=frame.image if number else dirty))
    return as_frames(made)


def sweeps() -> Sweeps:
    return Sweeps.of(tuple(replace(wall.sweep(instant), index=instant) for instant in range(INSTANTS)))


def test_a_spot_is_masked_with_its_soft_edge():
    found = find_dirt(frames(), sweeps(), ())
    assert found[0].mask[SPOT].all()
    # Half of its radius of 3.7 pixels around 42 pixels.
    assert SPOT.sum() < found[0].mask.sum() < 2.5 * SPOT.sum()
    assert found[0].error < 0.01
    assert not found[1].mask.any()


@pytest.mark.parametrize("opacity", [0.0, 0.5])
def test_nothing_and_what_hides_half_is_no_dirt(opacity: float):
    assert not find_dirt(frames(opacity), sweeps(), ())[0].mask.any()


def test_what_no_return_passes_behind_is_not_told():
    assert not find_dirt(frames(), Sweeps.of(()), ())[0].mask.any()
    beside = SPOT.roll(-12, 0)  # in the rows above the wall that the lidar sees
    above = [_below(sweep, -1.5) for sweep in sweeps()]
    assert not find_dirt(frames(spot=beside), Sweeps.of(tuple(above)), ())[0].mask.any()


def _below(sweep: Sweep, height: float) -> Sweep:
    kept = sweep.points[:, 1] > height
    return replace(sweep, points=sweep.points[kept], colors=sweep.colors[kept], colored=sweep.colored[kept])


def test_a_line_that_stays_is_no_spot():
    line = torch.zeros_like(SPOT)
    line[:, 30:33] = True
    assert not find_dirt(frames(spot=line), sweeps(), ())[0].mask.any()


def test_frames_lose_its_pixels_and_the_plan_says_so():
    log = DrivingLog("wall", frames(), sweeps(), (), INSTANTS, 2, torch.eye(4, dtype=torch.float64))
    data = StreetData(log, stride=20, offset=5, dirt=0.005)
    mask = data.driving_log.dirt[0].mask
    for part in (data.split.train, data.split.held_out, data.driving_log.frames):
        assert torch.equal(part[0].ego, mask)
        assert part[1].ego is None
    found = DirtSettings().detect(TrainingData(data.driving_log, data.split.train, frozenset()))
    assert (found.called_for, found.missing) == (True, None)
    assert found.value == pytest.approx(float(mask.float().mean()))
    assert StreetData(log, stride=20, offset=5).split.train[0].ego is None


def test_a_camera_that_stands_says_nothing():
    still = frames().at(range(20))  # 5.4 m
    assert find_dirt(still, sweeps(), ()) == {}
    log = DrivingLog("wall", still, sweeps(), (), 10, 2, torch.eye(4, dtype=torch.float64))
    found = DirtSettings().detect(TrainingData(log, still, frozenset()))
    assert not found.called_for
    assert "no camera of wall moves by 20 m" in found.reason
