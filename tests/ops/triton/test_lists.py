"""The tiles' lists: brute force over pixels as the oracle, on a grid that is not square."""

import dataclasses
import math

import pytest
import torch

from sparsestreet.ops import SplatSettings, contribution, leave_one_out, splat
from sparsestreet.ops.triton import lists
from sparsestreet.ops.triton.screen import Screen, project
from sparsestreet.ops.triton.view import KernelView
from sparsestreet.types import Camera, Gaussians, Shutter
from tests.ops.scenes import (
    camera,
    cast,
    device_of,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    render,
)
from tests.ops.triton.splitting import Rule, split_by, split_length

DEVICE = device_of("triton")
WIDTH, HEIGHT, TILE = 587, 171, 16
COLUMNS, ROWS = 37, 11
DEPTH = 10
"""Place of the depth in a record."""


def listed(screen: Screen) -> set[tuple[int, int]]:
    """(row, tile) of every pair, as the pixel kernels walk them."""
    found, pairs = screen.lists, set()
    for tile in range(len(found.begins)):
        rows = found.rows_of_pairs[int(found.begins[tile]) : int(found.ends[tile])].tolist()
        pairs |= {(row, tile) for row in rows}
    assert len(pairs) == len(found.pair_rows)
    return pairs


def touched(screen: Screen, rows: int, margin: float = 0.0, side: int = TILE) -> set[tuple[int, int, int]]:
    """Row, column and line of the squares of ``side`` pixels with a pixel center in the row's ellipse, which is widened
    by ``margin`` pixels; from the records, in float64, and over whole tiles."""
    y, x = torch.meshgrid(
        torch.arange(ROWS * TILE, dtype=torch.float64) + 0.5,
        torch.arange(COLUMNS * TILE, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    found = set()
    for row in range(rows):
        if screen.tile_counts[row] == 0:
            continue
        mean_x, mean_y, l11, l21, l22, log2_opacity, cutoff = screen.records[row, :7].double().cpu().tolist()
        dx, dy = x - mean_x, y - mean_y
        distance = torch.hypot(l11 * dx + l21 * dy, l22 * dy)
        # A pixel is at most so many units of L d.
        most = float(torch.linalg.matrix_norm(torch.tensor([[l11, l21], [0, l22]]), 2))
        inside = distance <= math.sqrt(max(log2_opacity - cutoff, 0)) + margin * most
        squares = torch.stack((x[inside], y[inside])).div(side).floor().long().unique(dim=1)
        found |= {(row, column, line) for column, line in squares.T.tolist()}
    return found


def ellipses() -> Gaussians:
    """Needles and balls all over the image and beyond its edges, two meters away."""
    generator = torch.Generator().manual_seed(2)
    rows = []
    for k in range(24):
        x, y, angle = (torch.rand(3, generator=generator, dtype=torch.float64) - 0.5).tolist()
        sizes = (10 ** (-2.3 + 1.6 * torch.rand(2, generator=generator, dtype=torch.float64))).tolist()
        rows.append(
            one_gaussian(
                means=[[3.2 * x, 1.0 * y, 2.0]],
                scales=[[*sizes, 0.01]],
                quaternions=[[math.cos(3 * angle), 0.0, 0.0, math.sin(3 * angle)]],
                opacities=[0.9 if k % 3 else 0.01],
            )
        )
    return Gaussians.concatenate(rows)


@pytest.fixture(scope="module")
def projected() -> tuple[Screen, Camera]:
    view = front_camera(WIDTH, HEIGHT, 400.0)
    scene = cast(ellipses(), torch.float32, device=DEVICE)
    return project(scene, KernelView(view, SplatSettings())), view


def test_no_touched_tile_is_missing_and_hardly_one_is_listed_in_vain(projected):
    screen, view = projected

    def needed(margin: float) -> set[tuple[int, int]]:
        return {
            (row, line * COLUMNS + column)
            for row, column, line in touched(screen, 24, margin)
            if column * TILE < view.width and line * TILE < view.height
        }

    assert len(needed(0.0)) > 150
    assert needed(0.0) <= listed(screen)
    # The margin against rounding is a hundredth of a pixel and 1e-5 of the ellipse.
    assert listed(screen) <= needed(0.05)


def test_no_touched_quadrant_is_missing_and_hardly_one_is_listed_in_vain(projected):
    screen, _ = projected
    lists, marked, tiles = screen.lists, set(), set()
    for tile in range(COLUMNS * ROWS):
        pairs = slice(int(lists.begins[tile]), int(lists.ends[tile]))
        line, column = divmod(tile, COLUMNS)
        for row, bits in zip(
            lists.rows_of_pairs[pairs].tolist(), lists.quadrants_of_pairs[pairs].tolist(), strict=True
        ):
            tiles.add((row, column, line))
            marked |= {(row, 2 * column + k % 2, 2 * line + k // 2) for k in range(4) if bits >> k & 1}

    def within(squares: set[tuple[int, int, int]]) -> set[tuple[int, int, int]]:
        return {square for square in squares if (square[0], square[1] // 2, square[2] // 2) in tiles}

    assert within(touched(screen, 24, side=8)) <= marked <= touched(screen, 24, margin=0.05, side=8)
    assert len(marked) < 3 * len(tiles)


def test_tiles_are_walked_nearest_first():
    view = camera(WIDTH, HEIGHT)
    screen = project(cast(random_gaussians(40, view), torch.float32, device=DEVICE), KernelView(view, SplatSettings()))
    lists, depths = screen.lists, screen.records[:, DEPTH]
    for begin, end in zip(lists.begins.tolist(), lists.ends.tolist(), strict=True):
        order = depths[lists.rows_of_pairs[begin:end].long()]
        assert (order[1:] >= order[:-1]).all()


@pytest.mark.parametrize("rows", [40, 700])
def test_tiles_start_by_the_power_of_two_of_their_length_and_neighbors_follow_each_other(rows):
    view = camera(WIDTH, HEIGHT)
    scene = cast(random_gaussians(rows, view), torch.float32, device=DEVICE)
    with split_by(Rule(min_part_pairs=2)):
        screen = project(scene, KernelView(view, SplatSettings()))
        lists, whole = screen.lists, split_length(len(screen.lists.slots))
    lengths = (lists.ends - lists.begins).tolist()

    def key(tile: int) -> tuple[float, int]:
        power = math.floor(math.log2(lengths[tile] / whole)) if lengths[tile] else -math.inf
        return -power, tile

    assert len({key(tile)[0] for tile in range(COLUMNS * ROWS)}) >= 3
    assert lists.order.tolist() == sorted(range(COLUMNS * ROWS), key=key)


def test_more_pairs_than_tiles():
    scene = Gaussians.concatenate([one_gaussian(means=[[0.0, 0.0, 2 + 0.01 * k]]) for k in range(300)])
    screen = project(cast(scene, torch.float32, device=DEVICE), KernelView(front_camera(9, 5, 20.0), SplatSettings()))
    assert screen.lists.rows_of_pairs.tolist() == list(range(300))


def test_many_tiles_take_wide_keys(monkeypatch):
    view = camera(19, 17)
    gaussians = random_gaussians(6, view)
    plain = render(gaussians, view, "triton", torch.float32)
    monkeypatch.setattr(lists, "_SHORT_KEYS", 2)
    wide = render(gaussians, view, "triton", torch.float32)
    for part in ("images", "gradients"):
        assert all(torch.equal(value, getattr(wide, part)[name]) for name, value in getattr(plain, part).items())


@pytest.mark.parametrize("laid_out", first_interpreted("transposed", "expanded"))
def test_displacements_in_any_layout(laid_out):
    view = dataclasses.replace(camera(9, 7), shutter=Shutter(torch.full((3,), 0.1), torch.zeros(3)))
    moved = torch.linspace(-0.5, 0.5, 18, device=DEVICE).view(3, 6).mT
    if laid_out == "expanded":
        moved = torch.tensor([0.3, -0.4, 0.2], device=DEVICE).expand(6, 3)
    assert not moved.is_contiguous()
    scene = cast(random_gaussians(6, view), torch.float32, device=DEVICE)
    strided, compact = (dataclasses.replace(scene, displacements=m) for m in (moved, moved.contiguous()))
    assert torch.equal(*(splat(g, view, backend="triton").rgb for g in (strided, compact)))
    for count in (contribution, leave_one_out):
        found, expected = (vars(count(g, view, backend="triton")) for g in (strided, compact))
        assert all(torch.equal(found[name], value) for name, value in expected.items())


@pytest.mark.parametrize(("edge", "distance"), [("left", 9), ("right", 8), ("top", 9), ("bottom", 8)])
def test_a_splat_that_ends_on_a_pixel_center_is_listed(edge, distance):
    # The mean is on the pixel center (24.5, 24.5) of 3 x 3 tiles; the next tiles' nearest centers lie 9 and 8 px away.
    # The splat ends 1e-6 before them: rounding in the pixel loop may still draw them, so they must be listed.
    view = front_camera(48, 48, 1000.0)
    view.intrinsics[:2, 2] = 24.5
    sigma = distance * (1 - 1e-6) / math.sqrt(2 * math.log(0.8 * 255))
    scene = one_gaussian(scales=[[sigma * 2 / 1000] * 3])
    screen = project(cast(scene, torch.float32, device=DEVICE), KernelView(view, SplatSettings(eps2d=1e-9)))
    assert (0, {"left": 3, "right": 5, "top": 1, "bottom": 7}[edge]) in listed(screen)


@pytest.mark.parametrize(
    "settings", first_interpreted(SplatSettings(), SplatSettings(max_sigma=2.0)), ids=["cut-off", "max_sigma"]
)
def test_culling_by_tiles_changes_no_bit(settings, monkeypatch):
    view = camera(35, 19)
    scene = cast(random_gaussians(12, view), torch.float32, device=DEVICE)
    culled = splat(scene, view, settings=settings, backend="triton")
    monkeypatch.setattr(KernelView, "bounded", False)  # every splat in every tile; the cut-offs of alpha stay
    everywhere = splat(scene, view, settings=settings, backend="triton")
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(getattr(culled, name), getattr(everywhere, name)), name
    pairs = [len(project(scene, KernelView(view, settings)).lists.slots)]
    monkeypatch.undo()
    pairs.append(len(project(scene, KernelView(view, settings)).lists.slots))
    assert pairs[0] > pairs[1]
