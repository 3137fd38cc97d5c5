"""What a view gives the pixel kernels to do, counted by hand."""

import torch

from sparsestreet.ops import SplatSettings
from sparsestreet.ops.triton.counters import count_work
from sparsestreet.types import Gaussians
from tests.ops.scenes import cast, device_of, front_camera, one_gaussian


def work(rows: list[Gaussians], width: int, height: int) -> tuple[int, int]:
    scene = cast(Gaussians.concatenate(rows), torch.float32, device=device_of("triton"))
    return count_work(scene, front_camera(width, height, 20.0), SplatSettings())


def layers(count: int, opacity: float) -> list[Gaussians]:
    return [
        one_gaussian(scales=[[90.0] * 3], opacities=[opacity], means=[[0.0, 0.0, 2 + k]]) for k in range(count)
    ]  # fmt: skip


def test_a_closed_tile_is_walked_to_the_next_look():
    assert work(layers(40, 1.0), 16, 16) == (40, 32 * 256)


def test_an_open_tile_is_walked_to_its_end():
    assert work(layers(40, 0.01), 9, 5) == (40, 40 * 256)


def test_tiles_and_quadrants_without_splats_are_no_work():
    # Tiles of 16 pixels: the splat, 1 px wide, is in the middle one of three, and in its upper left quadrant.
    assert work([one_gaussian(scales=[[0.01] * 3])], 41, 5) == (1, 64)
    assert work([one_gaussian(opacities=[0.0])], 41, 5) == (0, 0)
