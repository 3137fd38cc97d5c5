import pytest
import torch

from sparsestreet.scene.effects import Sky, SkySettings

AXES = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]).double()


def random_sky(side: int, dtype: torch.dtype = torch.float64) -> Sky:
    sky = Sky(SkySettings(resolution=side)).to(dtype)
    with torch.no_grad():
        sky.texels.copy_(torch.rand(sky.texels.shape, generator=torch.Generator().manual_seed(0), dtype=dtype))
    return sky


def directions_of(side: int) -> torch.Tensor:
    """Texel centers [6, side, side, 3] by hand: columns along y on x faces, else x; rows along y on z faces, else z."""
    grid = (torch.arange(side).double() + 0.5) / side * 2 - 1
    result = torch.empty(6, side, side, 3, dtype=torch.float64)
    for face in range(6):
        fixed, column_axis, row_axis = [(0, 1, 2), (1, 0, 2), (2, 0, 1)][face // 2]
        result[face, :, :, fixed] = 1.0 if face % 2 == 0 else -1.0
        result[face, :, :, column_axis] = grid[None, :]
        result[face, :, :, row_axis] = grid[:, None]
    return result


def test_the_start_is_gray():
    assert Sky().texels.shape == (6, 64, 64, 3)
    colors = Sky().colors(torch.randn(3, 4, 3, generator=torch.Generator().manual_seed(0)))
    torch.testing.assert_close(colors, torch.full((3, 4, 3), 0.5))  # four weights that sum to 1, rounded


@pytest.mark.parametrize("side", [1, 2, 5])
def test_every_texel_is_seen_along_its_own_direction(side: int):
    sky = random_sky(side)
    directions = 3.0 * directions_of(side).reshape(6 * side, side, 3)  # the length must not matter
    torch.testing.assert_close(sky.colors(directions).reshape(6, side, side, 3), sky.texels, atol=1e-12, rtol=0)


def test_faces_lie_where_their_axes_point():
    sky = random_sky(3)
    with torch.no_grad():
        sky.texels.copy_(torch.arange(6.0)[:, None, None, None].expand_as(sky.texels))
    assert sky.colors(AXES[None])[0, :, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_halfway_between_two_texels():
    sky = random_sky(4)
    directions = directions_of(4)
    between = (directions[2, 1, 2] + directions[2, 1, 3]) / 2
    expected = (sky.texels[2, 1, 2] + sky.texels[2, 1, 3]) / 2
    torch.testing.assert_close(sky.colors(between[None, None])[0, 0], expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("side", [1, 2, 5, 8])
def test_no_seam_along_the_edges_up_to_the_corners(side: int):
    """Stepping 2e-9 across any edge must not change the color of a random cube map beyond that step's slope."""
    sky = random_sky(side)
    generator = torch.Generator().manual_seed(1)
    for _ in range(200):
        edge = torch.empty(3, dtype=torch.float64)
        first, second, along = torch.randperm(3, generator=generator).tolist()
        signs = torch.randint(0, 2, (3,), generator=generator) * 2 - 1
        edge[first], edge[second] = signs[0], signs[1]
        # Half of them within half a texel of a corner of the cube, where three faces meet.
        reach = 1 - torch.rand((), generator=generator, dtype=torch.float64) * (1 / side if signs[2] > 0 else 2)
        edge[along] = reach * signs[2]
        step = torch.zeros(3, dtype=torch.float64)
        step[first] = 1e-9 * signs[0]
        here, there = sky.colors(torch.stack((edge + step, edge - step))[None])[0]
        assert (here - there).abs().max() < 1e-7  # slope of at most 8 texels a unit, times 2e-9, rounded up


@pytest.mark.parametrize("side", [1, 2, 5, 8])
def test_all_faces_agree_at_a_corner_of_the_cube(side: int):
    sky = random_sky(side)
    for corner in torch.cartesian_prod(*[torch.tensor([-1.0, 1.0]).double()] * 3):
        colors = sky.colors((1 + 1e-9 * torch.eye(3).double()) * corner)  # one direction on each of the three faces
        assert (colors - colors[0]).abs().max() < 1e-7  # slope of at most 8 texels a unit, times 1e-9, rounded up
