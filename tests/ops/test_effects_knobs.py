"""The box, the bits of the depth that are sorted, and what is done to colors, against hand-computed pixels."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.ops import SplatSettings, guards, splat
from sparsestreet.ops.spherical_harmonics import basis, view_colors
from sparsestreet.types import Gaussians
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    cotangents,
    every_double,
    every_precision,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    render,
)
from tests.typed import there

Y0 = 0.28209479177387814
RED, GREEN = [[[1.0 / Y0, 0.0, 0.0]]], [[[0.0, 1.0 / Y0, 0.0]]]


@every_precision
@pytest.mark.parametrize("alpha_min", [0.0, 1 / 255])
def test_box_by_hand(backend, dtype, alpha_min):
    # 0.1 m at 2 m with focal 40: variance 4 + 0.3. Two standard deviations: squared distance up to 17.2.
    view = front_camera(13, 13, 40.0)
    result = render(one_gaussian(), view, backend, dtype, SplatSettings(alpha_min=alpha_min, max_sigma=2.0))
    for row, column in np.ndindex(13, 13):
        squared = (row - 6) ** 2 + (column - 6) ** 2
        expected = 0.8 * math.exp(-0.5 * squared / 4.3) if squared <= 17.2 else 0.0
        assert float(result.images["alpha"][row, column]) == pytest.approx(expected, rel=1e-5), (row, column)
    assert float(result.radii[0]) == pytest.approx(2 * math.sqrt(4.3), rel=1e-6)


@every_double
def test_the_nearer_of_box_and_cut_off_ends_a_splat(backend):
    # Opacity 0.05 falls to 1/255 at q = 2 ln 12.75 = 5.09: a box of 2.25 (5.06) acts, one of 2.26 (5.11) does not.
    view = front_camera(13, 13, 40.0)
    faint = one_gaussian(opacities=[0.05])
    plain = render(faint, view, backend)
    assert float(plain.radii[0]) == pytest.approx(math.sqrt(2 * math.log(12.75) * 4.3), rel=1e-12)
    assert torch.equal(render(faint, view, backend, settings=SplatSettings(max_sigma=2.26)).radii, plain.radii)
    assert float(render(faint, view, backend, settings=SplatSettings(max_sigma=2.25)).radii[0]) == pytest.approx(
        2.25 * math.sqrt(4.3), rel=1e-12
    )


@every_precision
@pytest.mark.slow_if_interpreted
def test_a_box_that_ends_nothing_changes_no_bit(backend, dtype):
    view = camera(21, 13)
    gaussians = random_gaussians(60, view)
    # 1/255 of opacity 1 lies at 3.33 standard deviations; the square of 1e200 is no number.
    for box in (3.34, 1e200):
        plain, boxed = (render(gaussians, view, backend, dtype, SplatSettings(max_sigma=b)) for b in (math.inf, box))
        for part in ("images", "gradients"):
            for name, value in getattr(plain, part).items():
                assert torch.equal(value, getattr(boxed, part)[name]), name


@every_double
def test_gradients_inside_the_box_are_right(backend):
    # Pixels at a distance from the box's edge: there the image is smooth.
    view = front_camera(6, 5, 14.0)
    ball = one_gaussian(scales=[[0.3, 0.2, 0.25]], means=[[0.03, -0.02, 2.0]])
    for field in FIELDS:
        values = {name: getattr(ball, name).clone() for name in FIELDS}

        def image(value, field=field, values=values):
            settings = SplatSettings(max_sigma=1.0, alpha_min=0.0)
            return splat(Gaussians(**(values | {field: value})), view, settings=settings, backend=backend).rgb

        alpha = image(values[field])
        assert (alpha == 0).any()
        assert (alpha > 0).any()
        assert torch.autograd.gradcheck(image, values[field].requires_grad_(), fast_mode=True)


@every_precision
@pytest.mark.parametrize(
    ("bits", "far", "first_row_in_front"),
    [
        # Seven bits of mantissa: steps of 2^-6 = 0.0156 between 2 and 4.
        (16, 2.01, True),
        (16, 2.02, False),
        # None: powers of two.
        (9, 3.99, True),
        (9, 4.01, False),
        # Float64 depths are rounded to float32 first, and all bits are sorted for 32 only.
        (31, 2.0 + 2**-22, True),
        (31, 2.0 + 2**-21, False),
        (32, 2.0 + 2**-22, False),
    ],
)
def test_depth_bits(backend, dtype, bits, far, first_row_in_front):
    view = front_camera(5, 5, 40.0)
    wide = {"scales": [[90.0] * 3]}
    behind, before = one_gaussian(sh=RED, means=[[0.0, 0.0, far]], **wide), one_gaussian(sh=GREEN, **wide)
    rows = Gaussians.concatenate([behind, before])
    center = render(rows, view, backend, dtype, SplatSettings(depth_bits=bits)).images["rgb"][2, 2]
    front, back = (0, 1) if first_row_in_front else (1, 0)
    # 0.8 (0.5 + 1) + 0.2 * 0.8 * 0.5 in the front one's channel.
    assert float(center[front]) == pytest.approx(1.28, rel=1e-5)
    assert float(center[back]) == pytest.approx(0.8 * 0.5 + 0.2 * 0.8 * 1.5, rel=1e-5)


@every_double
def test_float64_depths_that_round_to_one_float32_are_tied(backend):
    view = front_camera(5, 5, 40.0)
    far, near = one_gaussian(sh=RED), one_gaussian(sh=GREEN, means=[[0.0, 0.0, 2.0 - 1e-9]])
    for bits, front in ((32, 1), (31, 0)):
        settings = SplatSettings(depth_bits=bits)
        center = render(Gaussians.concatenate([far, near]), view, backend, settings=settings).images["rgb"][2, 2]
        assert float(center[front]) == pytest.approx(1.28, rel=1e-6)


@every_precision
def test_half_colors_by_hand(backend, dtype):
    # Colors 0.5 + x; float16 has 11 significant bits; a value past 65504 stays there, where infinity would poison.
    colors = np.array([0.1, 1 / 3, 70000.0])
    ball = one_gaussian(sh=[[((colors - 0.5) / Y0).tolist()]])
    view, half = front_camera(5, 5, 40.0), SplatSettings(half_colors=True)
    assert guards(cast(ball, dtype), view, settings=half).alarms == {"color_held": 1}
    center = render(ball, view, backend, dtype, half)
    expected = 0.8 * np.minimum(colors, 65504).astype(np.float16).astype(np.float64)
    np.testing.assert_allclose(center.images["rgb"][2, 2].numpy(), expected, rtol=1e-6)
    assert center.is_finite()


@every_double
def test_half_colors_over_their_range(backend):
    # Subnormal numbers of float16 among them; in float64, where 0.5 + Y0 sh still has the digits of 1e-7.
    colors = np.array([2e-8, 4e-8, 3.3e-7, 5.9e-5, 6.2e-5, 1e-3, 0.2, 0.9999, 1.7, 33.3, 2047.7, 65503.0])
    for triple in colors.reshape(-1, 3):
        ball = one_gaussian(sh=[[((triple - 0.5) / Y0).tolist()]])
        seen = splat(ball, front_camera(1, 1, 40.0), settings=SplatSettings(half_colors=True), backend=backend)
        np.testing.assert_allclose(seen.rgb[0, 0].numpy(), 0.8 * triple.astype(np.float16).astype(float), rtol=1e-9)


@every_precision
@pytest.mark.slow_if_interpreted
def test_half_colors_in_a_scene(backend, dtype):
    view = camera(21, 13)
    gaussians = random_gaussians(60, view)
    plain, rounded = (
        render(gaussians, view, backend, dtype, SplatSettings(half_colors=half)) for half in (False, True)
    )
    difference = plain.images["rgb"] - rounded.images["rgb"]
    assert difference.any()
    # Half an ulp of float16 is 2.4e-4 below 1; evenly spread errors have a root mean square of 1.4e-4 (77 dB), and a
    # pixel's blend averages several and is darker.
    assert -10 * math.log10(float(difference.square().mean())) > 80
    # Straight through: the harmonics' gradient does not know about the rounding at all.
    assert torch.equal(plain.gradients["sh"], rounded.gradients["sh"])
    for name in FIELDS:
        assert relative_error(rounded.gradients[name], plain.gradients[name]) < 1e-2


@every_precision
def test_clamped_colors_by_hand(backend, dtype):
    # Colors 0.5 + x at alpha 0.8; a red that is clamped away from 1 has no gradient, nor has a blue below 0.
    ball = one_gaussian(sh=[[((np.array([1.5, 0.75, -0.25]) - 0.5) / Y0).tolist()]])
    seen = render(ball, front_camera(5, 5, 40.0), backend, dtype, SplatSettings(clamp_colors=True))
    assert seen.images["rgb"][2, 2].tolist() == pytest.approx([0.8, 0.6, 0.0], abs=1e-6)
    assert (seen.gradients["sh"][0, 0] != 0).tolist() == [False, True, False]
    open_above = render(ball, front_camera(5, 5, 40.0), backend, dtype)
    assert float(open_above.images["rgb"][2, 2, 0]) == pytest.approx(1.2, abs=1e-6)


def test_a_color_at_an_end_may_leave_it_again():
    """As torch's clamp has it. Backends that fuse products and sums round such colors to one side or the other."""
    ahead = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    steps = torch.arange(-8, 9)[:, None, None] * 2.0**-52
    for end in (0.0, 1.0):
        nearly = (end - 0.5) / Y0 * (1 + steps.double()).expand(-1, 1, 3)
        for clamped, moves in ((True, True), (False, end == 1.0)):
            sh = nearly.clone().requires_grad_()
            colors = view_colors(sh, ahead.expand(len(sh), 3), clamped)
            exact = (0.5 + basis(ahead, 1)[0, 0] * nearly[:, 0] == end).all(1)
            assert exact.any()
            colors.sum().backward()
            assert (there(sh.grad)[exact] != 0).all() == moves


@every_precision
def test_detached_colors_are_those_of_rows_without_a_direction(backend, dtype):
    """An independent oracle: rows that have the seen colors, clamped, as harmonics of degree 0."""
    view = camera(17, 13)
    rows = random_gaussians(12, view, terms=16, seed=3)
    rows = replace(rows, sh=3 * rows.dense_sh())
    toward = torch.nn.functional.normalize(rows.means - view.position, dim=1)
    colors = (0.5 + (basis(toward, 16)[..., None] * rows.dense_sh()).sum(1)).clamp(0, 1)
    assert (colors == 1).any()
    assert (colors == 0).any()
    settings = SplatSettings(clamp_colors=True, detach_directions=True)
    seen = render(rows, view, backend, dtype, settings)
    frozen = render(replace(rows, sh=((colors - 0.5) / Y0)[:, None]), view, "reference")
    # The bars of the op in its precision.
    image_bar, gradient_bar = (1e-12, 1e-10) if dtype == torch.float64 else (1e-5, 1e-4)
    assert (seen.images["rgb"] - frozen.images["rgb"]).abs().max() < image_bar
    for name in ("means", "quaternions", "scales", "opacities", "screen"):
        assert relative_error(seen.gradients[name], frozen.gradients[name]) < gradient_bar, name
    through = render(rows, view, backend, dtype, replace(settings, detach_directions=False))
    assert relative_error(through.gradients["means"], seen.gradients["means"]) > 1e-2


@every_double
def test_gradients_of_clamped_colors_are_right(backend):
    view = camera(6, 5)
    rows = random_gaussians(8, view, terms=9, seed=3)
    values = {name: getattr(rows, name).clone() for name in FIELDS} | {"sh": 3 * rows.dense_sh()}
    settings = SplatSettings(alpha_min=1e-9, clamp_colors=True)
    for field in ("means", "sh"):

        def image(value, field=field):
            return splat(Gaussians(**(values | {field: value})), view, settings=settings, backend=backend).rgb

        assert torch.autograd.gradcheck(image, values[field].clone().requires_grad_(), fast_mode=True)


@every_precision
@pytest.mark.parametrize("number", first_interpreted(3, 1))
def test_plain_gradients_on_screen_are_those_of_a_shifted_image(backend, dtype, number):
    """The oracle is the reference in float64: the principal point moves the splat, and nothing else, on the screen."""
    view, places = front_camera(9, 9, 40.0), [[0.03, -0.05, 2.0], [-0.06, 0.04, 2.2], [0.0, 0.02, 1.8]][:number]
    rows = one_gaussian(
        means=places,
        quaternions=[[1.0, 0.2, -0.3, 0.1]] * number,
        scales=[[0.1, 0.05, 0.07]] * number,
        opacities=[0.8] * number,
        sh=[[[0.5, -0.2, 0.1]]] * number,
    )
    settings = SplatSettings(transmittance_min=0.0, plain_gradients=True)
    seen, absolute = (
        render(rows, view, backend, dtype, replace(settings, plain_gradients=plain)).gradients
        for plain in (True, False)
    )

    def value(shift: tuple[float, float]) -> float:
        intrinsics = view.intrinsics.clone()
        intrinsics[:2, 2] += torch.tensor(shift)
        images = render(rows, replace(view, intrinsics=intrinsics), "reference", settings=settings).images
        return sum(float((image * v).sum()) for image, v in zip(images.values(), cotangents(view), strict=True))

    step = 1e-6
    slope = [
        (value(ahead) - value(behind)) / (2 * step)
        for ahead, behind in (((step, 0), (-step, 0)), ((0, step), (0, -step)))
    ]
    # Central differences of a value of size 100 are known to 1e-14 x 100 / 1e-6; float32 to the bar of the op.
    bar = 1e-5 if dtype == torch.float64 else 1e-4
    assert seen["screen"].sum(0).tolist() == pytest.approx(slope, rel=bar)
    # Sums of signed numbers are at most those of their absolute values; nothing else changes.
    assert bool((seen["screen"].abs() <= absolute["screen"] * (1 + bar)).all())
    assert float(seen["screen"].abs().sum()) < 0.8 * float(absolute["screen"].sum())
    assert all(torch.equal(seen[name], absolute[name]) for name in FIELDS)


def test_what_is_off_is_not_run(monkeypatch):
    # The graph of a plain camera holds nothing of the effects.
    def refused(*_):
        raise AssertionError("an effect ran that nobody asked for")

    for name in ("unscented", "screen_motion", "read_out", "_rounded_to_half", "fold_radius_squared"):
        monkeypatch.setattr(f"sparsestreet.ops.reference.projection.{name}", refused)
    view = camera(9, 7)
    leaves = cast(random_gaussians(20, view), torch.float64, requires_grad=True)
    splat(leaves, view, backend="reference").rgb.sum().backward()
    assert leaves.means.grad.any()
