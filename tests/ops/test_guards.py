"""Every guard on a row made for it; what must not disturb the counts."""

import dataclasses

import pytest
import torch

from sparsestreet.ops import Guards, SplatSettings, guards
from sparsestreet.types import Camera, Gaussians, Shutter
from tests.ops.scenes import (
    FIELDS,
    cast,
    front_camera,
    one_gaussian,
    random_gaussians,
)

Y0 = 0.28209479177387814
REASONS = (
    *("drawn", "masked", "near", "past_fold", "outruns_shutter"),
    *("vanished", "overflowed", "faint", "outside"),
)
LENS = (-0.3, 0.0, 0.0, 0.0, 0.0)
"""Folds at r = 1.054."""
SHARP = SplatSettings(eps2d=0.0)
every_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def lensed(view: Camera, coefficients: tuple[float, ...] = LENS) -> Camera:
    return dataclasses.replace(view, distortion=torch.tensor(coefficients, dtype=torch.float64))


def rolling(view: Camera) -> Camera:
    still = torch.zeros(3, dtype=torch.float64)
    return dataclasses.replace(view, shutter=Shutter(still, still))


def moved(gaussians: Gaussians, displacement: list[float]) -> Gaussians:
    return dataclasses.replace(gaussians, displacements=torch.tensor([displacement], dtype=torch.float64))


def rows_counted(counted: Guards) -> int:
    return sum(getattr(counted, name) for name in REASONS)


def huge(dtype: torch.dtype) -> list[list[float]]:
    """Finite scales whose determinant, their fourth power, is not."""
    return [[1e25] * 3] if dtype == torch.float32 else [[1e100] * 3]


@every_dtype
def test_each_reason_by_hand(dtype):
    view, lens = front_camera(9, 10, 20.0), lensed(front_camera(41, 31, 20.0))
    one = SplatSettings()
    # The ball falls by 0.95 image heights during the readout: 1 - u_y / H = 0.05.
    falling = moved(one_gaussian(), [0.0, 0.95 * 10 / 20 * 2, 0.0])
    cases = [
        ("drawn", one_gaussian(), view, one),
        ("masked", one_gaussian(opacities=[0.0]), view, one),
        ("near", one_gaussian(means=[[0.0, 0.0, 0.2]]), view, one),
        ("near", one_gaussian(means=[[0.0, 0.0, -3.0]]), view, one),
        ("past_fold", one_gaussian(means=[[2.12, 0.0, 2.0]]), lens, one),
        ("outruns_shutter", falling, rolling(view), one),
        ("drawn", falling, view, one),
        ("vanished", one_gaussian(scales=[[1e-9] * 3]), view, SHARP),
        ("overflowed", one_gaussian(scales=huge(dtype)), view, one),
        ("faint", one_gaussian(opacities=[0.003]), view, one),
        ("drawn", one_gaussian(opacities=[0.003]), view, SplatSettings(alpha_min=0.001)),
        ("outside", one_gaussian(means=[[5.0, 0.0, 2.0]]), view, one),
        ("outside", one_gaussian(means=[[0.0, -5.0, 2.0]]), view, one),
    ]
    for name, row, camera, settings in cases:
        counted = guards(cast(row, dtype), camera, settings=settings)
        held = {"slope_held": 0, "sigma_point_held": 0}
        assert dataclasses.replace(counted, **held) == Guards(**{name: 1}), name
        # What is not drawn has its reason alone.
        assert name == "drawn" or counted == Guards(**{name: 1}), name


@every_dtype
def test_antialias_can_make_a_row_faint(dtype):
    # sigma = 1e-3 px: compensated to the floor, 0.8 * 0.005 = 1 / 250; 0.7 * 0.005 = 1 / 286 is below 1 / 255.
    view, settings = front_camera(5, 5, 20.0), SplatSettings(antialias=True)
    seen, faint = (one_gaussian(opacities=[o], scales=[[1e-4] * 3]) for o in (0.8, 0.7))
    assert guards(cast(seen, dtype), view, settings=settings) == Guards(drawn=1, compensation_held=1)
    assert guards(cast(faint, dtype), view, settings=settings) == Guards(faint=1)


@every_dtype
def test_the_first_reason_counts(dtype):
    # Each row has its reason and those after it, as far as a row can have both.
    view = rolling(lensed(front_camera(21, 31, 20.0)))
    tiny, beside, gone = [[1e-9] * 3], [1.6, 0.0, 2.0], [2.4, 0.0, 2.0]
    # From 0.8 the lens images x at 0.646: 2.9 px outside of a 21 px wide image.
    fast, still = [0.0, 30.0, 0.0], [0.0, 0.0, 0.0]
    rows = [
        ("masked", {"opacities": [0.0], "means": [[2.4, 0.0, -2.0]], "scales": tiny}, fast),
        ("near", {"opacities": [0.003], "means": [[2.4, 0.0, -2.0]], "scales": tiny}, fast),
        ("past_fold", {"opacities": [0.003], "means": [gone], "scales": tiny}, fast),
        ("outruns_shutter", {"opacities": [0.003], "means": [beside], "scales": tiny}, fast),
        ("outruns_shutter", {"opacities": [0.003], "means": [beside], "scales": huge(dtype)}, fast),
        ("vanished", {"opacities": [0.003], "means": [beside], "scales": tiny}, still),
        ("overflowed", {"opacities": [0.003], "means": [beside], "scales": huge(dtype)}, still),
        ("faint", {"opacities": [0.003], "means": [beside], "scales": [[1e-2] * 3]}, still),
        ("outside", {"opacities": [0.8], "means": [beside], "scales": [[1e-2] * 3]}, still),
    ]
    scene = [moved(one_gaussian(**fields), displacement) for _, fields, displacement in rows]
    for (name, *_), row in zip(rows, scene, strict=True):
        assert guards(cast(row, dtype), view, settings=SHARP) == Guards(**{name: 1}), name
    together = guards(cast(Gaussians.concatenate(scene), dtype), view, settings=SHARP)
    assert together == Guards(**({name: 1 for name, *_ in rows} | {"outruns_shutter": 2}))
    assert together.alarms == {"vanished": 1, "overflowed": 1}


def check_each_alone(dtype: torch.dtype, cases: list[tuple[str | None, Gaussians, Camera, SplatSettings]]) -> None:
    """Of (guard or None, row, camera, settings): the row is drawn, and no other guard counts it."""
    for index, (name, row, view, settings) in enumerate(cases):
        counted = guards(cast(row, dtype), view, settings=settings)
        assert counted == Guards(drawn=1, **({} if name is None else {name: 1})), (index, name)
        assert counted.alarms == dict.fromkeys({"identity_quaternion", "color_held"} & {name}, 1)


@every_dtype
def test_each_guard_of_shapes_by_hand(dtype):
    view, one = front_camera(20, 16, 20.0), SplatSettings()
    lens, large = lensed(view), {"scales": [[0.7, 0.5, 0.6]]}
    cases = [
        ("identity_quaternion", one_gaussian(quaternions=[[0.0] * 4]), view, one),
        # 20 px at focal 20: half the field of view is 0.5, limits 0.65; in y 0.4 and 0.52.
        (None, one_gaussian(means=[[1.28, 0.0, 2.0]], **large), view, one),
        ("slope_held", one_gaussian(means=[[1.32, 0.0, 2.0]], **large), view, one),
        ("slope_held", one_gaussian(means=[[-1.32, 0.0, 2.0]], **large), view, one),
        (None, one_gaussian(means=[[0.0, 1.02, 2.0]], **large), view, one),
        ("slope_held", one_gaussian(means=[[0.0, -1.06, 2.0]], **large), view, one),
        (None, one_gaussian(means=[[1.32, 0.0, 2.0]]), lens, one),
        # Sigma points at mu +- 1.73 scales. 2 - 1.73 * 1.0392 = 0.2 m; 1.73 * 1.217 / 2 is the fold.
        (None, one_gaussian(scales=[[0.1, 0.1, 1.038]]), lens, one),
        ("sigma_point_held", one_gaussian(scales=[[0.1, 0.1, 1.041]]), lens, one),
        (None, one_gaussian(scales=[[0.1, 1.21, 0.1]]), lens, one),
        ("sigma_point_held", one_gaussian(scales=[[0.1, 1.22, 0.1]]), lens, one),
    ]
    check_each_alone(dtype, cases)


@every_dtype
def test_each_guard_of_alpha_and_color_by_hand(dtype):
    view, one, half = front_camera(20, 16, 20.0), SplatSettings(), SplatSettings(half_colors=True)
    antialias, tiny = SplatSettings(antialias=True), one_gaussian(scales=[[3.8e-3] * 3], opacities=[0.9])
    bright = one_gaussian(sh=[[[0.0, (70000.0 - 0.5) / Y0, 0.0]]])
    cases = [
        # sigma^2 / (sigma^2 + 0.3) = 0.005 at sigma = 0.0388 px, with 10 px a meter at 2 m.
        (None, one_gaussian(scales=[[3.9e-3] * 3], opacities=[0.9]), view, antialias),
        ("compensation_held", tiny, view, antialias),
        (None, tiny, view, one),
        (None, one_gaussian(opacities=[0.98]), view, one),
        ("alpha_clamped", one_gaussian(opacities=[1.0]), view, one),
        ("alpha_clamped", one_gaussian(opacities=[0.98]), view, SplatSettings(alpha_max=0.9)),
        # The compensation of sigma = 1 px is 1 / 1.3: the opacity is at most 0.77.
        (None, one_gaussian(opacities=[1.0]), view, antialias),
        (None, one_gaussian(sh=[[[0.0, -0.49 / Y0, 0.0]]]), view, one),
        ("color_cut", one_gaussian(sh=[[[0.0, -0.51 / Y0, 0.0]]]), view, one),
        (None, bright, view, one),
        (None, one_gaussian(sh=[[[(65503.0 - 0.5) / Y0, 0.0, 0.0]]]), view, half),
        ("color_held", bright, view, half),
    ]
    if dtype == torch.float64:  # Rounded to half it is 0, but it was not cut; float32 does not hold 0.5 + 1e-8.
        cases.append((None, one_gaussian(sh=[[[(1e-8 - 0.5) / Y0] * 3]]), view, half))
    check_each_alone(dtype, cases)


@every_dtype
def test_anything_may_stand_in_a_masked_row(dtype):
    view = rolling(lensed(front_camera(21, 13, 20.0)))
    gaussians = cast(random_gaussians(9, view), dtype)
    gaussians = dataclasses.replace(gaussians, displacements=torch.zeros_like(gaussians.means))
    gaussians.opacities[4] = 0
    expected = guards(gaussians, view)
    assert expected.masked == 1
    for name in FIELDS:
        if name != "opacities":
            getattr(gaussians, name)[4] = torch.nan
    gaussians.displacements[4] = torch.inf
    assert guards(gaussians, view) == expected
    assert rows_counted(expected) == 9


@pytest.mark.parametrize("field", FIELDS)
def test_bad_values_of_other_rows_are_errors(field):
    view = front_camera(21, 13, 20.0)
    gaussians = random_gaussians(9, view)
    gaussians.opacities[2] = 0
    getattr(gaussians, field)[5].view(-1)[-1] = torch.nan
    with pytest.raises(ValueError, match=f"{field} must be finite, but row 5 has nan"):
        guards(gaussians, view)


def test_half_precision_is_an_error():
    gaussians = cast(one_gaussian(), torch.bfloat16)
    with pytest.raises(ValueError, match=r"guards computes in float32 or float64, got torch\.bfloat16: convert"):
        guards(gaussians, front_camera(5, 5, 20.0))


@every_dtype
def test_no_rows_and_the_sum_of_views(dtype):
    view = front_camera(21, 13, 20.0)
    assert guards(cast(random_gaussians(0, view), dtype), view) == Guards()
    first, second = Guards(drawn=2, near=1, color_cut=2), Guards(drawn=1, overflowed=3)
    assert first + second == Guards(drawn=3, near=1, overflowed=3, color_cut=2)
    assert (first + second).alarms == {"overflowed": 3}
    assert (first + Guards()).alarms == {}


def test_counting_takes_no_part_in_training():
    # Rows that ask for gradients, under autocast: the same counts, and nothing is kept for a backward pass.
    def refused(_):
        raise AssertionError("a tensor was saved for backward")

    view = front_camera(21, 13, 20.0)
    gaussians = random_gaussians(60, view)
    leaves = cast(gaussians, torch.float32, requires_grad=True)
    hooks = torch.autograd.graph.saved_tensors_hooks(refused, refused)
    with torch.autocast("cpu", dtype=torch.bfloat16), hooks:
        counted = guards(leaves, view)
    assert counted == guards(cast(gaussians, torch.float32), view)
