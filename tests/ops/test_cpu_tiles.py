"""The C++ backend compiled for other tiles draws the same. Each size is compiled once, into ``.cache``."""

import math
import shutil

import pytest
import torch
from torch import Tensor

from sparsestreet.bench import sweep
from sparsestreet.bench.knobs import DEFAULT, Point
from sparsestreet.bench.scenes import Size, bench_scenes
from sparsestreet.bench.tile_sizes import build, with_tiles
from sparsestreet.bench.timing import TimingBudget, work_of
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.cpu import rasterizer
from sparsestreet.ops.cpu.library import load_library, tile_size
from sparsestreet.types import Gaussians
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    cotangents,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    with_threads,
)
from tests.typed import there

ONCE = TimingBudget(repeats=2, seconds=0.0, least=1)
# Not the order in which a pixel blends, only where a distance is rounded depends on the tile: images of colors below
# about 2. Gradients are summed tile by tile, in another order.
IMAGE_BAR = {torch.float32: 1e-6, torch.float64: 1e-14}
ROW_BAR = {torch.float32: 1e-5, torch.float64: 1e-13}
WIDTH, HEIGHT = 75, 53

# One process compiles for all tests.
pytestmark = pytest.mark.slow


@pytest.fixture(params=[8, 32])
def size(request) -> int:
    """With a compiler at hand, not to be compiled is a failure."""
    if shutil.which("cmake") is None or shutil.which("c++") is None:
        pytest.skip("no cmake or no compiler for another size")
    assert build(request.param).missing is None
    return request.param


def drawn(dtype: torch.dtype, variant: int, settings: SplatSettings) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Layers of an image, and what each row gets: gradients, counters and changes; ordinary splats and a few giants,
    one of which reaches further than 8x8 tiles of 8 pixels."""
    view = camera(WIDTH, HEIGHT)
    giants = random_gaussians(6, view, seed=1)
    giants.scales.mul_(8)
    gaussians = Gaussians.concatenate([random_gaussians(250, view), giants])
    leaves = cast(gaussians, dtype, requires_grad=True)
    offsets = torch.zeros(len(gaussians), 2, dtype=dtype, requires_grad=True)
    raster = rasterizer.rasterize(leaves, offsets, view, settings, variant)
    layers = {"rgb": raster.rgb, "transmittance": raster.transmittance, "depth": raster.depth_sum / 30}
    torch.autograd.backward(list(layers.values()), [v.to(dtype) for v in cotangents(view)])
    plain = cast(gaussians, dtype)
    counted = rasterizer.contribution(plain, view, settings, variant)
    changes = rasterizer.leave_one_out(plain, None, None, view, settings, variant)
    rows = {name: getattr(leaves, name).grad for name in FIELDS} | {"screen": there(offsets.grad)}
    rows |= {"weight": counted.weight, "pixels": counted.pixels.double(), "dominant": counted.dominant.double()}
    rows |= {"largest": changes.max_abs_change, "squared": changes.squared_change}
    return {name: layer.detach() for name, layer in layers.items()}, rows


@pytest.mark.parametrize("stop", ["inclusive", "exclusive"])
@pytest.mark.parametrize("variant", [0, 1, 2])
def test_other_tiles_draw_the_same(size, variant, stop):
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    settings = SplatSettings(stop=stop, transmittance_min=0.05)
    for dtype, bar in IMAGE_BAR.items():
        layers, rows = drawn(dtype, variant, settings)
        other_layers, other_rows = with_tiles(size, drawn, dtype, variant, settings)
        for name, layer in layers.items():
            assert (other_layers[name] - layer).abs().max() <= bar, name
        for name, value in rows.items():
            assert value.abs().sum() > 0, f"{name}: the scene tests nothing"
            assert relative_error(other_rows[name], value) <= ROW_BAR[dtype], name


def giant_pairs() -> int:
    """(splat, tile) pairs of a ball that covers the whole image."""
    giant = cast(one_gaussian(scales=[[90.0] * 3]), torch.float32)
    return there(work_of(giant, front_camera(WIDTH, HEIGHT, 40.0), SplatSettings(), "cpu")[0])


def test_the_library_has_the_tiles_it_was_compiled_for(size):
    assert with_tiles(size, tile_size) == size
    for side, pairs in ((size, with_tiles(size, giant_pairs)), (tile_size(), giant_pairs())):
        assert pairs == math.ceil(WIDTH / side) * math.ceil(HEIGHT / side)


def test_as_many_threads_as_here(size):
    assert with_threads((3,), lambda: with_tiles(size, torch.get_num_threads)) == [3]


def test_a_tile_size_in_the_sweep(size):
    scene = bench_scenes(Size(48, 32, 120))[0]
    point = Point("tile size", str(size), DEFAULT, tile=size)
    record = sweep.measure_point(scene, point, sweep.Truths(scene), ONCE)
    default = sweep.measure_point(scene, Point("default", "default", DEFAULT), sweep.Truths(scene), ONCE)
    assert record.tiles_in_use.image.maximum <= 1e-6
    pairs, by_default = there(record.times.pairs), there(default.times.pairs)
    assert (pairs > by_default, pairs < by_default) == (size < tile_size(), size > tile_size())
    assert default.tiles_in_use is None
    assert record.exact.image.mean == pytest.approx(default.exact.image.mean, rel=1e-4)
    assert "from the tiles in use" in sweep.describe(record)
