"""How pairs lie on tiles, counted by hand."""

import pytest
import torch

from sparsestreet.bench.tile_loads import TileLoads, loads, loads_of
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.triton.tuning import Tuning, tuned
from sparsestreet.types import Gaussians
from tests.ops.scenes import cast, device_of, front_camera, one_gaussian


def test_room_without_parts_does_not_count():
    tiles, given = torch.tensor([7, 0, 2, 1]), torch.tensor([4, 3, 0, 0])
    assert loads(tiles, given, 1) == TileLoads(2.5, 1.5, 7, 1, 2, 4)
    assert loads(tiles[:3], given[:0], 0) == TileLoads(3.0, 2.0, 7, 0, 0, 0)


def test_other_backends_do_not_say():
    assert loads_of(one_gaussian(), front_camera(16, 16, 20.0), SplatSettings(), "cpu") is None


@pytest.mark.interpreted
def test_a_long_tile_and_a_short_one():
    """Ten splats on two of three tiles, six of them on one alone: 10, 4 and 0 pairs, parts of at least three."""
    both = [one_gaussian(scales=[[0.4, 0.1, 0.1]], means=[[-0.5, 0.0, 2 + 0.01 * k]]) for k in range(4)]
    one = [one_gaussian(scales=[[0.01] * 3], means=[[-1.3, 0.0, 2 + 0.01 * k]]) for k in range(6)]
    scene = cast(Gaussians.concatenate([*both, *one]), torch.float32, device=device_of("triton"))
    with tuned(Tuning(shortest_part=3)):
        found = loads_of(scene, front_camera(48, 16, 20.0), SplatSettings(), "triton")
    assert found == TileLoads(14 / 3, 4.0, 10, 1, 3, 4)
