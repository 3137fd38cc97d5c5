"""Bad input is one clear error that names the invariant, the value and the remedy; a missing library says so."""

import dataclasses

import pytest
import torch

from sparsestreet.ops import (
    PairLimitError,
    SplatSettings,
    backend,
    contribution,
    guards,
    leave_one_out,
    resolve_backend,
    splat,
)
from sparsestreet.ops.cpu import library
from sparsestreet.ops.validate import check_structure
from sparsestreet.types import Camera, Shutter
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    device_of,
    every_fast_backend,
    every_precision,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    render,
)

VIEW = camera(9, 7)
BACKENDS = ["reference", "cpu"]
CPU = torch.device("cpu")


def unchecked(value, **changes):
    """A copy with fields replaced that the shape annotations, checked in tests alone, would refuse."""
    copy = object.__new__(type(value))
    for field in dataclasses.fields(value):
        object.__setattr__(copy, field.name, changes.get(field.name, getattr(value, field.name)))
    return copy


@every_precision
@pytest.mark.parametrize("poison", [float("nan"), -float("inf")])
@pytest.mark.parametrize("field", [*FIELDS, "displacements"])
def test_value_that_is_not_finite(field, poison, backend, dtype):
    still = random_gaussians(15, VIEW, terms=16)
    moving = dataclasses.replace(still, displacements=torch.zeros_like(still.means))
    gaussians = cast(moving, dtype, device=device_of(backend))
    assert splat(gaussians, VIEW, backend="reference").radii[12] > 0
    getattr(gaussians, field)[12].view(-1)[-1] = poison
    for call in (splat, contribution):
        with pytest.raises(ValueError, match=f"{field} must be finite, but row 12 has {poison}"):
            call(gaussians, VIEW, backend=backend)


@every_precision
def test_rows_of_opacity_0_may_hold_anything(backend, dtype):
    gaussians = dataclasses.replace(random_gaussians(20, VIEW), displacements=torch.zeros(20, 3, dtype=torch.float64))
    gaussians.opacities[5:9] = 0
    view = dataclasses.replace(VIEW, distortion=torch.full((5,), 0.01), shutter=Shutter(torch.ones(3), torch.ones(3)))
    expected = [render(gaussians, seen, backend, dtype) for seen in (VIEW, view)]
    for field, poison in zip(
        (*FIELDS, "displacements"), (1e38, *[float("nan")] * 2, 0.0, float("inf"), 1e38), strict=True
    ):
        getattr(gaussians, field)[5:9] = poison
    gaussians.means[5:8] = float("nan")
    for seen, plain in zip((VIEW, view), expected, strict=True):
        result = render(gaussians, seen, backend, dtype)
        for name, image in plain.images.items():
            assert torch.equal(result.images[name], image), name
        for name, gradient in plain.gradients.items():
            assert torch.equal(result.gradients[name], gradient), name
    cut = cast(gaussians, dtype, device=device_of(backend))
    assert torch.isfinite(contribution(cut, VIEW, backend=backend).weight).all()
    assert torch.isfinite(leave_one_out(cut, VIEW, backend=backend).squared_change).all()


@every_precision
def test_harmonics_are_read_only_of_rows_that_are_drawn(backend, dtype):
    gaussians = random_gaussians(12, VIEW, terms=16)
    # Too faint, beside the image, behind the camera.
    gaussians.opacities[3] = 0.001
    gaussians.means[5, 1] += 500
    gaussians.means[7] -= 100 * VIEW.camera_from_world[2, :3]
    expected = render(gaussians, VIEW, backend, dtype)
    hidden = expected.radii == 0
    assert hidden.nonzero().flatten().tolist() == [3, 5, 7]
    gaussians.dense_sh()[hidden] = torch.tensor([float("nan"), float("inf"), -float("inf")], dtype=torch.float64)
    result = render(gaussians, VIEW, backend, dtype)
    for part in ("images", "gradients"):
        for name, value in getattr(expected, part).items():
            assert torch.equal(getattr(result, part)[name], value), name
    cut = cast(gaussians, dtype, device=device_of(backend))
    assert torch.isfinite(contribution(cut, VIEW, backend=backend).weight).all()
    assert torch.isfinite(leave_one_out(cut, VIEW, backend=backend).squared_change).all()
    assert guards(cut, VIEW).drawn == int((~hidden).sum())


@every_precision
@pytest.mark.parametrize("terms", first_interpreted(16, 9, 4, 1))
def test_any_coefficient_of_a_row_that_is_drawn(backend, dtype, terms):
    # The first and the last row of a block, and coefficients at the ends of what is read together.
    for row, place in ((0, 0), (0, 3 * terms - 1), (1, 15), (1, 16), (1, 3 * terms - 2)):
        gaussians = one_gaussian(sh=[[[0.1] * 3] * terms])
        both = cast(type(gaussians).concatenate([gaussians] * 2), dtype, device=device_of(backend))
        place = min(place, 3 * terms - 1)
        both.dense_sh()[row].view(-1)[place] = float("nan")
        for call in (splat, contribution, leave_one_out):
            with pytest.raises(ValueError, match=f"sh must be finite, but row {row} has nan"):
                call(both, front_camera(3, 3, 5.0), backend=backend)


@every_precision
def test_finite_harmonics_whose_sum_overflows_are_no_error(backend, dtype):
    # The color is infinite, which shows; no value is bad.
    largest = float(torch.finfo(dtype).max)
    bright = cast(one_gaussian(sh=[[[largest] * 3] * 4], means=[[-1.0, -1.0, 1.0]]), dtype, device=device_of(backend))
    view = front_camera(9, 9, 2.0)
    assert torch.isinf(splat(bright, view, backend=backend).rgb).any()


@every_precision
@pytest.mark.parametrize(
    ("field", "value", "invariant"),
    [
        ("opacities", 1.5, r"lie in \[0, 1\]"),
        ("opacities", -0.5, r"lie in \[0, 1\]"),
        ("scales", -0.5, "be >= 0 meters"),
    ],
)
def test_values_out_of_range(backend, dtype, field, value, invariant):
    gaussians = cast(random_gaussians(5, VIEW), dtype, device=device_of(backend))
    getattr(gaussians, field)[3].view(-1)[-1] = value
    with pytest.raises(ValueError, match=f"{field} must {invariant}, but row 3 has {value}"):
        contribution(gaussians, VIEW, backend=backend)


WHOLE = [getattr(one_gaussian(), name).expand(5, *getattr(one_gaussian(), name).shape[1:]) for name in FIELDS]
SIDEWAYS = unchecked(Shutter(torch.ones(3), torch.ones(3)), direction="TOP")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": torch.zeros(4, 3)}, r"quaternions must have shape \[4, 4\].*got \[5, 4\]"),
        ({"opacities": torch.zeros(5, 1)}, r"opacities must have shape \[5\]"),
        ({"sh": torch.zeros(5, 5, 3)}, "sh must hold 1, 4, 9 or 16 terms.*got 5"),
        ({"scales": torch.zeros(5, 3, dtype=torch.float64)}, "share one dtype.*scales is torch.float64"),
        ({"scales": torch.zeros(5, 3, device="meta")}, "share one dtype and device.*scales is torch.float32 on meta"),
        (dict(zip(FIELDS, map(torch.Tensor.long, WHOLE), strict=True)), "means must be floating point"),
        ({"displacements": torch.zeros(4, 3)}, r"displacements must be \[5, 3\] torch.float32 on cpu like the means"),
    ],
)
def test_structure(changes, message):
    gaussians = unchecked(cast(random_gaussians(5, VIEW), torch.float32), **changes)
    with pytest.raises(ValueError, match=message):
        check_structure(gaussians, VIEW, None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "at least 1x1 pixels, got width 0"),
        ({"height": 2**22 + 1}, "at most 4194304 pixels wide and high, got 9x4194305: render it in parts"),
        ({"width": 2**15 + 1, "height": 2**14}, "at most 536870912 pixels, got 32769x16384: render it in parts"),
        ({"width": 21.0}, r"width must be an int, got 21.0: convert it with int\(\)"),
        ({"height": True}, "height must be an int, got True"),
        ({"height": torch.tensor(7)}, r"height must be an int, got tensor\(7\)"),
        ({"camera_from_world": torch.eye(3)}, r"camera_from_world must have shape \[4, 4\]"),
        ({"camera_from_world": torch.full((4, 4), float("nan"))}, "camera_from_world must be finite"),
        ({"camera_from_world": torch.diag(torch.tensor([2.0, 2, 2, 1]))}, "must be a rigid motion.*R R.T is off by 3"),
        ({"camera_from_world": torch.diag(torch.tensor([1.0, 1, 0.999, 1]))}, "R R.T is off by 0.001999"),
        ({"camera_from_world": torch.diag(torch.tensor([0.0, 0, 0, 1]))}, "R R.T is off by 1"),
        ({"camera_from_world": torch.diag(torch.tensor([1.0, 1, -1, 1]))}, "must be a rigid motion.*det R = -1"),
        ({"camera_from_world": torch.diag(torch.tensor([1.0, 1, 1, 2]))}, r"last row \[0.0, 0.0, 0.0, 2.0\]"),
        ({"intrinsics": torch.tensor([[9.0, 0.5, 4], [0, 9, 3], [0, 0, 1]])}, "intrinsics must be.*skew"),
        ({"intrinsics": torch.tensor([[0.0, 0, 4], [0, 9, 3], [0, 0, 1]])}, "positive focal lengths"),
        ({"shutter": SIDEWAYS}, "direction must be one of top, bottom, left, right, got 'TOP': name the side"),
        ({"shutter": Shutter(torch.full((3,), torch.nan), torch.ones(3))}, "shutter.translation must be 3 finite numb"),
    ],
)
def test_camera(changes, message):
    with pytest.raises(ValueError, match=message):
        check_structure(one_gaussian(), unchecked(VIEW, **changes), None)


def test_poses_with_few_digits_are_rigid():
    # Four digits, as text files keep them: R R^T is off by 1e-4.
    rounded = dataclasses.replace(VIEW, camera_from_world=VIEW.camera_from_world.round(decimals=4))
    assert (rounded.camera_from_world != VIEW.camera_from_world).any()
    check_structure(one_gaussian(), rounded, None)


@pytest.mark.parametrize("k", [1e200, -1e200, 1e13, float("nan")])
@pytest.mark.parametrize("place", range(5))
def test_distortion_that_no_lens_has(place, k):
    lens = torch.zeros(5, dtype=torch.float64)
    lens[place] = k
    with pytest.raises(ValueError, match=r"distortion must be 5 numbers of at most 1e\+12, got .*check k1, k2"):
        splat(one_gaussian(), dataclasses.replace(VIEW, distortion=lens), backend="reference")


@pytest.mark.lengthy
@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_wildest_distortion_that_is_taken_is_finite(name, dtype):
    generator = torch.Generator().manual_seed(0)
    gaussians = random_gaussians(40, VIEW)
    moving = Shutter(torch.full((3,), 0.1), torch.full((3,), 0.01))
    for seed in range(20):
        exponents = 16 * torch.rand(5, generator=generator, dtype=torch.float64) - 4
        lens = 10 ** (exponents if seed else 0 * exponents + 12) * torch.randn(5, generator=generator).sign()
        view = dataclasses.replace(VIEW, distortion=lens, shutter=moving)
        assert render(gaussians, view, name, dtype).is_finite(), lens


@pytest.mark.lengthy
@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("axis", [0, 1])
def test_the_last_pixel_of_the_longest_image(axis, name):
    # Its center is exact in float32. A small splat there, and one over everything.
    length = 2**22
    view = front_camera(*((length, 1) if axis == 0 else (1, length)), 100.0)
    view.intrinsics[axis, 2] = length - 0.5
    lone = cast(one_gaussian(scales=[[0.001] * 3]), torch.float32)
    alpha = splat(lone, view, backend=name).alpha.flatten()
    assert float(alpha[-1]) == pytest.approx(0.8, rel=1e-6)
    assert alpha[-2] > 0
    assert not alpha[:-9].any()
    wide = cast(one_gaussian(scales=[[1e7] * 3], opacities=[0.5]), torch.float32)
    assert splat(wide, view, backend=name).alpha.min() > 0.49


@pytest.mark.parametrize(
    ("background", "message"),
    [
        (torch.zeros(4, dtype=torch.float64), r"background must have shape \[3\] or \[7, 9, 3\], got \[4\]"),
        (torch.zeros(3), "background must be torch.float64"),
        (torch.tensor([0.0, float("nan"), 0.0]).double(), r"background must be finite, .* at \[1\] it is nan"),
        (torch.full((7, 9, 3), float("inf")).double(), r"background must be finite, .* at \[0, 0, 0\] it is inf"),
    ],
)
def test_background(background, message):
    with pytest.raises(ValueError, match=message):
        check_structure(one_gaussian(), VIEW, background)


def test_a_background_whose_sum_overflows_is_finite():
    bright = torch.full((3,), 3e38)
    assert torch.isinf(bright.sum())
    check_structure(cast(one_gaussian(), torch.float32), VIEW, bright)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -0.5])
def test_pixel_weights(value):
    weights = torch.ones(7, 9, dtype=torch.float64)
    weights[2, 3] = value
    with pytest.raises(ValueError, match=rf"pixel_weights must be finite and >= 0, but at \[2, 3\] it is {value}: "):
        leave_one_out(one_gaussian(), VIEW, pixel_weights=weights)
    with pytest.raises(ValueError, match=r"pixel_weights must be \[7, 9\] .*64 on cpu like the means, got \[9, 7\]"):
        leave_one_out(one_gaussian(), VIEW, pixel_weights=weights.T)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("alpha_max", 1.0),
        ("alpha_min", 0.995),
        ("alpha_min", -0.1),
        ("transmittance_min", 1.0),
        ("stop", "sometimes"),
        ("eps2d", float("nan")),
        ("near_plane", 0.0),
    ],
)
def test_settings(field, value):
    with pytest.raises(ValueError, match=f"{field} must .*got {value!r}"):
        unchecked(SplatSettings(), **{field: value}).__post_init__()


def test_presets():
    assert SplatSettings.preset("default") == SplatSettings()
    names = ("default", "exact", "gsplat15", "gsplat16", "inria", "fast", "drivestudio")
    assert len({SplatSettings.preset(name) for name in names}) == len(names)
    with pytest.raises(ValueError, match=r"no settings preset 'faster': choose one of .*'fast'"):
        SplatSettings.preset("faster")


def test_backends_that_cannot_run():
    with pytest.raises(ValueError, match="no splat backend 'tritn': choose one of"):
        resolve_backend("tritn", CPU)
    with pytest.raises(ValueError, match="needs tensors on the cpu, got meta"):
        resolve_backend("cpu", torch.device("meta"))


@pytest.fixture
def without_library(monkeypatch):
    monkeypatch.setattr(backend, "find_library", lambda: None)
    monkeypatch.setattr(backend, "_warned", set())


@pytest.mark.usefixtures("without_library")
def test_auto_without_the_library_warns_once_and_takes_the_reference():
    with pytest.warns(RuntimeWarning, match="library is not built.*compiler.*pip install"):
        assert resolve_backend("auto", CPU) == "reference"
    # Warnings are errors in these tests: a second one would raise.
    assert resolve_backend("auto", CPU) == "reference"


@pytest.mark.usefixtures("without_library")
def test_cpu_without_the_library_says_how_to_build_it():
    with pytest.raises(RuntimeError, match="'cpu' is not built: install a C\\+\\+17 compiler"):
        splat(one_gaussian(), VIEW, backend="cpu")


def test_library_built_from_other_sources(monkeypatch):
    monkeypatch.setattr(library, "_INTERFACE_VERSION", 999)
    with pytest.raises(RuntimeError, match=r"has interface .*needs 999"):
        library.load_library.__wrapped__()


@every_fast_backend
def test_more_pairs_than_may_be_held(monkeypatch, backend):
    view = front_camera(64, 48, 40.0)
    giant = one_gaussian(scales=[[90.0] * 3])
    gaussians = type(giant).concatenate([one_gaussian(means=[[0.0, 0.0, -2.0]]), giant, one_gaussian()])
    gaussians = cast(gaussians, torch.float32, device=device_of(backend))
    limit = {"cpu": "cpu.rasterizer.PAIR_LIMIT", "triton": "triton.lists.PAIR_LIMIT"}[backend]
    # The ball of 0.1 m lies in the middle and reaches 7 px: tiles 1, 2 of rows 1; and the giant covers all 4 x 3.
    monkeypatch.setattr(f"sparsestreet.ops.{limit}", 14)
    contribution(gaussians, view, backend=backend)
    monkeypatch.setattr(f"sparsestreet.ops.{limit}", 13)
    with pytest.raises(PairLimitError, match=r"cover 14 tiles, more than the 13.*row 1 \(12\), row 2 \(2\)\. Prune"):
        contribution(gaussians, view, backend=backend)


@pytest.mark.lengthy
def test_pairs_beyond_32_bits_are_counted_not_allocated():
    # 16,400 opaque giants over 512 x 512 tiles of a 8192 x 8192 image: 2^32 pairs and 4e6, which alone would be taken.
    rows = 16_400
    giant = one_gaussian(scales=[[900.0] * 3], opacities=[1.0])
    gaussians = type(giant)(
        *(getattr(giant, name).expand(rows, *getattr(giant, name).shape[1:]).float() for name in FIELDS)
    )
    view = front_camera(8192, 8192, 100.0, torch.float32)
    with pytest.raises(PairLimitError, match=f"cover {rows * 512 * 512} tiles"):
        contribution(gaussians, Camera(view.camera_from_world, view.intrinsics, 8192, 8192), backend="cpu")
