"""Effects and knobs of the C++ backend against the reference, in both precisions and on every instruction set."""

import dataclasses
import itertools

import pytest
import torch

from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.cpu import rasterizer
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.types import Camera, Gaussians, Shutter
from tests.ops.scenes import FIELDS, camera, cast, cotangents, random_gaussians, relative_error, render, with_threads

pytestmark = pytest.mark.lengthy


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


LENSES = {"pinhole": None, "folds": vector(-0.25, 0.08, 2e-3, -1e-3, -0.05), "opens": vector(0.1, 0.05, -1e-3, 2e-3, 0)}
MOTION = vector(0.15, -0.3, 0.3), vector(0.02, 0.04, 0.02)
SHUTTERS = {
    "global": None,
    "rolling": Shutter(*MOTION),
    "bottom": Shutter(*MOTION, "bottom"),
    "left": Shutter(*MOTION, "left"),
    "right": Shutter(*MOTION, "right"),
}
SETTINGS = {
    "default": SplatSettings(),
    "knobs": SplatSettings(max_sigma=1.7, depth_bits=14, half_colors=True, antialias=True, stop="exclusive"),
    "box alone": SplatSettings(max_sigma=2.5, alpha_min=0.0, transmittance_min=0.0),
}


def view_through(lens: str, shutter: str, width: int = 37, height: int = 29) -> Camera:
    return dataclasses.replace(camera(width, height), distortion=LENSES[lens], shutter=SHUTTERS[shutter])


def walking(rows: int, view: Camera, terms: int = 4, seed: int = 0) -> Gaussians:
    speeds = 0.3 * torch.randn(rows, 3, generator=torch.Generator().manual_seed(seed))
    return dataclasses.replace(random_gaussians(rows, view, terms=terms, seed=seed), displacements=speeds.double())


@pytest.mark.parametrize(
    ("lens", "shutter", "settings"),
    [
        *itertools.product(LENSES, ("global", "rolling"), SETTINGS),
        *itertools.product(LENSES, ("bottom", "left", "right"), ("knobs",)),
    ],
)
def test_float64_equals_the_reference(lens, shutter, settings):
    view = view_through(lens, shutter)
    gaussians = walking(250, view)
    truth, result = (render(gaussians, view, name, torch.float64, SETTINGS[settings]) for name in ("reference", "cpu"))
    assert torch.equal(result.radii > 0, truth.radii > 0)
    for part in ("images", "gradients"):
        for name, value in getattr(truth, part).items():
            assert value.norm() > 0, name
            assert relative_error(getattr(result, part)[name], value) < 1e-9, name


@pytest.mark.parametrize(
    ("lens", "shutter"), [("folds", "global"), ("pinhole", "rolling"), ("opens", "rolling"), ("folds", "right")]
)
def test_float32_gradients(lens, shutter):
    view = view_through(lens, shutter)
    gaussians = walking(250, view)
    truth = render(gaussians, view, "reference", torch.float64)
    result = render(gaussians, view, "cpu", torch.float32)
    assert (result.images["rgb"] - truth.images["rgb"]).abs().max() < 1e-5
    # The unscented transform takes differences of pixels, which are known to 37 * 6e-8 here.
    for name, value in truth.gradients.items():
        assert relative_error(result.gradients[name], value) < 1e-4, name


@pytest.mark.parametrize("rows", [0, 1, 3, 17, 33])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("shutter", ["rolling", "left"])
def test_registers_need_not_be_full(rows, dtype, shutter):
    view = view_through("opens", shutter)
    gaussians = walking(rows, view, terms=16)
    many = Gaussians.concatenate([gaussians, walking(40, view, terms=16, seed=1)])
    hidden = dataclasses.replace(many, opacities=torch.where(torch.arange(rows + 40) < rows, many.opacities, 0.0))
    alone, among = (render(scene, view, "cpu", dtype) for scene in (gaussians, hidden))
    for name, image in alone.images.items():
        assert torch.equal(image, among.images[name]), name
    for name, gradient in alone.gradients.items():
        assert torch.equal(gradient, among.gradients[name][:rows]), name
        assert not among.gradients[name][rows:].any(), name


@pytest.mark.parametrize("variant", [0, 1, 2])
@pytest.mark.parametrize("shutter", ["rolling", "right"])
def test_every_instruction_set(variant, shutter):
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    view = view_through("folds", shutter)
    gaussians = walking(200, view, terms=16)
    truth = cast(gaussians, torch.float64, requires_grad=True)
    splat(truth, view, settings=SETTINGS["knobs"], backend="reference").rgb.backward(cotangents(view)[0])
    for dtype, bar in ((torch.float64, 1e-9), (torch.float32, 1e-4)):
        leaves = cast(gaussians, dtype, requires_grad=True)
        offsets = torch.zeros(len(gaussians), 2, dtype=dtype, requires_grad=True)
        raster = rasterizer.rasterize(leaves, offsets, view, SETTINGS["knobs"], variant)
        raster.rgb.backward(cotangents(view)[0].to(dtype))
        for name in FIELDS:
            assert relative_error(getattr(leaves, name).grad.double(), getattr(truth, name).grad) < bar, name


def test_displacements_must_be_finite():
    view = view_through("pinhole", "rolling")
    gaussians = walking(40, view)
    gaussians.displacements[23, 1] = float("nan")
    with pytest.raises(ValueError, match="displacements must be finite, but row 23 has nan"):
        splat(gaussians, view, backend="cpu")


def test_bitwise_equal_for_any_number_of_threads():
    view = view_through("folds", "rolling", 70, 50)
    gaussians = walking(3001, view)
    results = with_threads((1, 2, 3), lambda: render(gaussians, view, "cpu", torch.float32, SETTINGS["knobs"]))
    for other in results[1:]:
        for part in ("images", "gradients"):
            for name, value in getattr(results[0], part).items():
                assert torch.equal(value, getattr(other, part)[name]), name
