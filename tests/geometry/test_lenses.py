"""Lens models against OpenCV, closed forms, hand-computed cases and each other."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from sparsestreet.geometry import lenses
from sparsestreet.geometry.lenses import (
    BrownConrady,
    Fisheye,
    FTheta,
    Lens,
    Mei,
    Rational,
    _continued_jacobian,
    angles_from_axis,
    distort,
    distortion_jacobian,
    fold_radius_squared,
    largest_shift,
    undistort,
)
from tests.typed import there

FOCAL = {"fx": 400.0, "fy": 410.0, "cx": 321.5, "cy": 239.0}
CAMERA_MATRIX = np.array([[400.0, 0, 321.5], [0, 410, 239], [0, 0, 1]])
RATIONAL = {"k1": 0.9, "k2": 0.2, "p1": 1e-3, "p2": -2e-3, "k3": 0.01, "k4": 1.2, "k5": 0.4, "k6": 0.05}
PRISM = {"s1": 1e-3, "s2": -2e-4, "s3": -3e-3, "s4": 5e-4}
FISHEYE = {"k1": -0.03, "k2": 0.012, "k3": -0.008, "k4": 0.0013}
KITTI_360 = {"xi": 2.2134, "k1": 0.0168, "k2": 1.6549, "gamma1": 1336.32, "gamma2": 1335.79, "u0": 716.94, "v0": 705.76}
"""Of its left fisheye, without the tangential terms, as its own programs use it."""


def directions(widest: float, count: int = 200) -> torch.Tensor:
    """Of different lengths, up to some degrees from the axis."""
    generator = torch.Generator().manual_seed(1)
    angle, azimuth, length = torch.rand(3, count, generator=generator, dtype=torch.float64)
    angle, azimuth, length = math.radians(widest) * angle, 2 * math.pi * azimuth, 0.1 + 50 * length
    rays = (angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), angle.cos())
    return length[:, None] * torch.stack(rays, -1)


def by_opencv(rays: torch.Tensor, coefficients: list[float]) -> np.ndarray:
    pixels, _ = cv2.projectPoints(rays.numpy(), np.zeros(3), np.zeros(3), CAMERA_MATRIX, np.array(coefficients))
    return pixels[:, 0]


@pytest.mark.parametrize("prism", [{}, PRISM], ids=["rational", "with thin prism"])
def test_the_rational_model_is_opencvs(prism):
    coefficients = [*RATIONAL.values(), *prism.values()]
    rays = directions(60)
    # Both in float64, of numbers of some hundreds.
    lens = Rational(**FOCAL, **RATIONAL, **prism)
    np.testing.assert_allclose(lens.project(rays).numpy(), by_opencv(rays, coefficients), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "coefficients", [[-0.28, 0.09, 2e-3, -1e-3, -0.012], [0.2, 0.05, -0.03, 0.02, 0.01]], ids=["barrel", "pincushion"]
)
def test_brown_conrady_is_opencvs(coefficients):
    lens = BrownConrady(**FOCAL, **dict(zip(("k1", "k2", "p1", "p2", "k3"), coefficients, strict=True)))
    rays = directions(40)  # before the fold of the barrel at 47 degrees
    expected = by_opencv(rays, coefficients)
    np.testing.assert_allclose(lens.project(rays).numpy(), expected, rtol=0, atol=1e-9)
    assert BrownConrady.of(lens.pinhole, lens.brown_conrady()) == lens
    assert torch.isnan(lens.project(-rays)).all()


def test_a_fisheye_is_opencvs():
    rays = directions(89)  # OpenCV divides by z
    pixels, _ = cv2.fisheye.projectPoints(
        rays.numpy()[:, None], np.zeros(3), np.zeros(3), CAMERA_MATRIX, np.array([*FISHEYE.values()])
    )
    np.testing.assert_allclose(Fisheye(**FOCAL, **FISHEYE).project(rays).numpy(), pixels[:, 0], rtol=0, atol=1e-9)


def test_a_fisheye_sees_behind_itself():
    lens = Fisheye(fx=100.0, fy=200.0, cx=10.0, cy=20.0)
    behind = torch.tensor([[1.0, 0, -1], [0, -1, -1]], dtype=torch.float64)  # 135 degrees from the axis
    expected = torch.tensor([[10 + 75 * math.pi, 20], [10, 20 - 150 * math.pi]], dtype=torch.float64)
    torch.testing.assert_close(lens.project(behind), expected, rtol=1e-14, atol=1e-12)


def test_f_theta_is_a_fisheye_of_other_numbers():
    """radius = f theta (1 + k1 theta^2 + ...), whose even powers are zero."""
    fisheye = Fisheye(**FOCAL | {"fy": 400.0}, **FISHEYE)
    k1, k2, k3, k4 = (400 * k for k in FISHEYE.values())
    lens = FTheta(polynomial=(0.0, 400.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4), cx=321.5, cy=239.0)
    rays = directions(120)
    torch.testing.assert_close(lens.project(rays), fisheye.project(rays), rtol=0, atol=1e-9)


def test_f_theta_by_hand():
    # (3, 4, 0) is 90 degrees from the axis: radius 100 t + 10 t^2 along (0.6, 0.8), then [[1.1, 0.2], [0.3, 1]].
    lens = FTheta(polynomial=(0.0, 100.0, 10.0), cx=7.0, cy=9.0, linear=(1.1, 0.2, 0.3), max_angle=1.6)
    radius = 50 * math.pi + 2.5 * math.pi**2
    expected = [7 + radius * (1.1 * 0.6 + 0.2 * 0.8), 9 + radius * (0.3 * 0.6 + 0.8)]
    assert lens.project(torch.tensor([3.0, 4, 0], dtype=torch.float64)).tolist() == pytest.approx(expected, rel=1e-14)
    assert lens.pinhole.flatten().tolist() == pytest.approx([110, 0, 7, 0, 100, 9, 0, 0, 1])
    # 1.7 rad from the axis: beyond what it was fitted to.
    assert torch.isnan(lens.project(torch.tensor([math.sin(1.7), 0, math.cos(1.7)], dtype=torch.float64))).all()


def test_mei_by_hand():
    # Of (2, -3, 6) / 7 and xi = 1/7: x = 2/7, y = -3/7, r2 = 13/49; radial = 1 + 0.1 r2 + 0.2 r2^2.
    lens = Mei(xi=1 / 7, gamma1=70.0, gamma2=140.0, u0=5.0, v0=6.0, k1=0.1, k2=0.2, p1=0.01, p2=0.02)
    x, y, r2 = 2 / 7, -3 / 7, 13 / 49
    radial = 1 + 0.1 * r2 + 0.2 * r2**2
    column = 5 + 70 * (x * radial + 0.02 * x * y + 0.02 * (r2 + 2 * x * x))
    row = 6 + 140 * (y * radial + 0.01 * (r2 + 2 * y * y) + 0.04 * x * y)
    assert lens.project(torch.tensor([2.0, -3, 6], dtype=torch.float64)).tolist() == pytest.approx([column, row])


def test_mei_between_a_pinhole_and_a_stereographic_projection():
    rays, tangential = directions(55), {"k1": -0.1, "k2": 0.02, "p1": 1e-3, "p2": -2e-3}
    focal = {"gamma1": 400.0, "gamma2": 410.0, "u0": 321.5, "v0": 239.0}
    expected = BrownConrady(**FOCAL, **tangential).project(rays)
    torch.testing.assert_close(Mei(xi=0.0, **focal, **tangential).project(rays), expected, rtol=0, atol=1e-9)
    rays = directions(150)
    radius = torch.tan(angles_from_axis(rays) / 2)  # sin / (cos + 1)
    found = (Mei(xi=1.0, **focal).project(rays) - torch.tensor([321.5, 239.0])) / torch.tensor([400.0, 410.0])
    torch.testing.assert_close(found.norm(dim=-1), radius, rtol=1e-12, atol=0)


LENSES: dict[str, Lens] = {
    "brown_conrady": BrownConrady(**FOCAL, k1=-0.1),
    "rational": Rational(**FOCAL, **RATIONAL),
    "fisheye": Fisheye(**FOCAL, **FISHEYE),
    "mei": Mei(**KITTI_360),
    "f_theta": FTheta(polynomial=(0.0, 930.0, 0.0, -20.0), cx=960.0, cy=540.0, linear=(1.01, 0.0, 0.0)),
}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
def test_its_pinhole_agrees_at_the_center(lens):
    steps = 1e-5 * torch.tensor([[1.0, 0], [0, 1], [-1, 0], [0, -1], [0, 0]], dtype=torch.float64)
    rays = torch.cat((steps, torch.ones(5, 1)), 1)
    right, down, left, up, center = lens.project(rays)
    (fx, _, cx), (_, fy, cy), _ = lens.pinhole.tolist()
    # Differences of second order, and of second order in 1e-5: 1e-10, and 1e-16 * 1000 / 1e-5 of rounding.
    assert float(right[0] - left[0]) / 2e-5 == pytest.approx(fx, rel=1e-8)
    assert float(down[1] - up[1]) / 2e-5 == pytest.approx(fy, rel=1e-8)
    assert center.tolist() == pytest.approx([cx, cy])


def test_reach():
    # theta - 0.3 theta^3 grows up to 1 / sqrt(0.9); two cells of the grid are a quarter of a degree.
    fold, step = math.sqrt(1 / 0.9), math.radians(1 / 4)
    assert 0 <= fold - Fisheye(**FOCAL, k1=-0.3).reach <= step
    # sin / (cos + xi) grows up to cos = -1 / xi.
    assert 0 <= math.acos(-1 / 2.2134) - Mei(**KITTI_360 | {"k1": 0.0, "k2": 0.0}).reach <= step
    assert Mei(**KITTI_360 | {"xi": 0.5, "k1": 0.0, "k2": 0.0}).reach == pytest.approx(math.acos(-0.5), abs=1e-5)
    # r (1 - 0.3 r^2) grows up to r = 1 / sqrt(0.9); r / (1 + r^2) up to 1.
    assert 0 <= math.atan(fold) - Rational(**FOCAL, k1=-0.3).reach <= step
    assert 0 <= math.radians(45) - Rational(**FOCAL, k4=1.0).reach <= step
    # A denominator of 0 at r = 1.
    assert 0 <= math.radians(45) - Rational(**FOCAL, k4=-1.0).reach <= step
    assert Fisheye(**FOCAL).reach == math.pi
    wide = Fisheye(**FOCAL, k1=-0.3).project(directions(170))
    assert 0.2 < float(torch.isnan(wide).any(-1).double().mean()) < 0.8


def test_within_its_reach_no_pixel_shows_two_directions():
    """A tangential field turns over in one direction alone: 1 + 6 p1 y is 0 at y = -0.56."""
    lens = Rational(**FOCAL, p1=0.3, k4=0.01)
    azimuth = torch.linspace(0, 2 * math.pi, 1001, dtype=torch.float64)

    def areas(angle: float) -> torch.Tensor:
        """Of the image of small squares there, over those of their directions, by differences."""
        tips = torch.tensor([[0.0, 0], [1e-6, 0], [0, 1e-6]], dtype=torch.float64)
        angles, turns = angle + tips[:, :1], azimuth + tips[:, 1:]
        rays = torch.stack((angles.sin() * turns.cos(), angles.sin() * turns.sin(), angles.cos() + 0 * turns), -1)
        at = lens.image(rays)
        out, across = at[1] - at[0], at[2] - at[0]
        return out[:, 0] * across[:, 1] - out[:, 1] * across[:, 0]

    assert math.degrees(lens.reach) == pytest.approx(math.degrees(math.atan(1 / 1.8)), abs=0.5)  # and 1 % of k4
    assert areas(lens.reach - math.radians(0.5)).min() > 0
    assert areas(lens.reach + math.radians(0.5)).min() < 0


def test_a_lens_that_folds_inside_of_its_image_is_refused():
    folding = Fisheye(**FOCAL, k1=-0.3)  # at 60 degrees, 0.70 focal lengths from the center: 281 and 288 pixels
    replace(folding, cx=195.0, cy=195.0).check(390, 390)
    with pytest.raises(ValueError, match=r"this Fisheye folds back 60\.\d degrees from its axis, inside"):
        folding.check(800, 600)
    with pytest.raises(ValueError, match="this Rational folds back"):
        Rational(**FOCAL, p1=1.0, p2=1.0, k4=1e-9).check(640, 480)
    # A circular fisheye shows nothing in its corners, and f-theta says where it ends.
    LENSES["mei"].check(1400, 1400)
    replace(LENSES["f_theta"], max_angle=0.8).check(1920, 1080)
    for lens in LENSES.values():
        lens.check(640, 480)


def test_a_rational_lens_may_be_brown_conradys():
    five = {name: RATIONAL[name] for name in ("k1", "k2", "p1", "p2", "k3")}
    assert there(Rational(**FOCAL, **five).brown_conrady()).tolist() == [*five.values()]
    assert BrownConrady(**FOCAL, **five).brown_conrady().tolist() == [*five.values()]
    for name in ("k4", "k5", "k6", "s1", "s2", "s3", "s4"):
        assert Rational(**FOCAL, **five, **{name: 1e-6}).brown_conrady() is None
    assert all(LENSES[name].brown_conrady() is None for name in ("fisheye", "mei", "f_theta"))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Fisheye(**FOCAL, k1=math.nan), "k1 of a lens must be finite, got nan"),
        (lambda: Fisheye(**FOCAL | {"fx": -1.0}), "focal lengths of a lens must be positive"),
        (lambda: Mei(**KITTI_360 | {"xi": -1.0}), "xi of a lens must be larger than -1"),
        (lambda: Mei(**KITTI_360 | {"gamma1": 0.0}), "focal lengths"),
        (lambda: FTheta(polynomial=(0.0,), cx=1.0, cy=1.0), "the polynomial of an f-theta lens"),
        (lambda: FTheta(polynomial=(20.0, 1.0), cx=1.0, cy=1.0), "starts at the center"),
        (lambda: FTheta(polynomial=(0.0, math.inf), cx=1.0, cy=1.0), "polynomial of a lens must be finite"),
        (lambda: FTheta(polynomial=(0.0, 1.0), cx=1.0, cy=1.0, max_angle=4.0), "max_angle must lie within"),
    ],
)
def test_numbers_that_are_no_lens(make, words):
    with pytest.raises(ValueError, match=words):
        make()


BARREL = torch.tensor([-0.3, 0.1, 0.0, 0.0, -0.02], dtype=torch.float64)
"""A wide-angle front camera's order of magnitude."""
FULL = torch.tensor([-0.28, 0.09, 2e-3, -1e-3, -0.012], dtype=torch.float64)
PINCUSHION = torch.tensor([0.2, 0.05, 0.0, 0.0, 0.01], dtype=torch.float64)


def test_no_coefficients_no_distortion():
    points = torch.randn(20, 2, dtype=torch.float64)
    assert torch.equal(distort(points, torch.zeros(5)), points)


def test_fold_by_hand():
    # 1 + 3 k1 u = 0; 1 + 5 k2 u^2 = 0; 1 + 7 k3 u^3 = 0; (1 - u)(1 - u / 2) = 1 - 1.5 u + 0.5 u^2.
    def fold(k1=0.0, k2=0.0, k3=0.0):
        return fold_radius_squared(torch.tensor([k1, k2, 0.3, 0.3, k3], dtype=torch.float64))

    assert fold(k1=-0.1) == pytest.approx(1 / 0.3, rel=1e-12)
    assert fold(k2=-0.05) == pytest.approx(2.0, rel=1e-12)
    assert fold(k3=-1 / 56) == pytest.approx(2.0, rel=1e-12)
    assert fold(k1=-0.5, k2=0.1) == pytest.approx(1.0, rel=1e-12)
    # Too small a k3 to matter must not disturb the fold that k1 makes.
    assert fold(k1=-0.1, k3=1e-30) == pytest.approx(1 / 0.3, rel=1e-12)
    # Not folding, but too steep: 1 + 3 k1 u = 4; 1 - 0.3 u + 0.5 u^2 = 4.
    assert fold(k1=0.1) == pytest.approx(10, rel=1e-12)
    assert fold(k1=-0.1, k2=0.1) == pytest.approx(0.3 + math.sqrt(0.09 + 6), rel=1e-12)
    assert fold() == math.inf


@pytest.mark.parametrize("coefficients", [BARREL, FULL], ids=["barrel", "full"])
def test_fold_is_where_the_radius_stops_growing(coefficients):
    limit = math.sqrt(fold_radius_squared(coefficients))
    radial = coefficients * torch.tensor([1, 1, 0, 0, 1])
    radii = torch.linspace(0, 3 * limit, 4001, dtype=torch.float64)
    distorted = distort(torch.stack((radii, 0 * radii), -1), radial)[:, 0]
    # Continued past the fold it still grows, and it has no step.
    steps = distorted.diff()
    assert (steps > 0).all()
    assert steps.max() < 2 * 3 * limit / 4000
    k1, k2, _, _, k3 = coefficients.tolist()
    plain = radii + k1 * radii**3 + k2 * radii**5 + k3 * radii**7
    before = radii <= limit
    torch.testing.assert_close(distorted[before], plain[before])
    assert plain.diff()[before[1:]].min() > 0 > plain.diff()[~before[1:]][1]


def test_past_the_fold_it_is_proportional_to_the_radius():
    edge = math.sqrt(fold_radius_squared(FULL)) * torch.tensor([[0.6, 0.8], [-0.8, 0.6]], dtype=torch.float64)
    torch.testing.assert_close(distort(2.5 * edge, FULL), 2.5 * distort(edge, FULL), rtol=1e-12, atol=0)


@pytest.mark.parametrize("reach", [0.9, 3.0], ids=["before the fold", "across it"])
def test_derivative_in_the_points(reach):
    points = reach * (torch.rand(9, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 0.5)
    assert torch.autograd.gradcheck(lambda value: distort(value, FULL), points.requires_grad_())
    # The center, where the radius has no derivative.
    assert torch.autograd.gradcheck(lambda value: distort(value, FULL), torch.zeros(1, 2).double().requires_grad_())


@pytest.mark.parametrize("coefficients", [FULL, PINCUSHION], ids=["full", "pincushion"])
@pytest.mark.parametrize(
    ("jacobian", "reach"), [(distortion_jacobian, 1.0), (_continued_jacobian, 6.0)], ids=["before the fold", "across"]
)
def test_jacobian(coefficients, jacobian, reach):
    points = reach * (torch.rand(9, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 0.5)
    for point, value in zip(points, jacobian(points, coefficients), strict=True):
        expected = torch.autograd.functional.jacobian(lambda at: distort(at, coefficients), point)
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("coefficients", [BARREL, FULL, PINCUSHION], ids=["barrel", "full", "pincushion"])
@pytest.mark.parametrize("reach", [1.0, 6.0], ids=["before the fold", "across it"])
def test_inverse(coefficients, reach):
    points = reach * (torch.rand(500, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64) - 0.5)
    imaged = distort(points, coefficients)
    found = undistort(imaged, coefficients)
    torch.testing.assert_close(distort(found, coefficients), imaged, rtol=1e-9, atol=1e-9)
    if reach == 1.0:  # At the fold itself the tangential terms give some points a second origin.
        torch.testing.assert_close(found, points, rtol=0, atol=1e-12)
    assert undistort(imaged.float(), coefficients).dtype == torch.float32
    assert undistort(points[:0], coefficients).shape == (0, 2)


def test_no_inverse_is_an_error():
    # Tangential terms of 1 fold the plane within the image: nothing is imaged at (-2, -2).
    wild = torch.tensor([0.0, 0.0, 1.0, 1.0, 0.0], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"must have an inverse, but Newton's method is .* off for coefficients \[0.0"):
        undistort(torch.tensor([[-2.0, -2.0]], dtype=torch.float64), wild)
    # At other places the matrix of a step is singular.
    with pytest.raises(ValueError, match="must have an inverse"):
        largest_shift(torch.tensor([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), wild, 40, 40)


def test_the_inverse_stops_when_all_points_are_found(monkeypatch):
    steps = []
    jacobian = lenses._continued_jacobian
    monkeypatch.setattr(lenses, "_continued_jacobian", lambda *a: steps.append(a) or jacobian(*a))
    points = torch.rand(100, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 0.5
    torch.testing.assert_close(undistort(distort(points, FULL), FULL), points, rtol=0, atol=1e-14)
    assert 2 <= len(steps) <= 6  # digits double: 1e-1, 1e-2, 1e-4, 1e-8, and the step that is checked


def test_the_largest_shift_by_hand():
    """r = 1 is imaged at 1 + 0.1: (0.6, 0.8) at (0.66, 0.88), the top left corner, the farthest from the center."""
    intrinsics = torch.tensor([[100.0, 0, 66], [0, 200, 176], [0, 0, 1]])
    lens = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0])
    assert largest_shift(intrinsics, lens, 120, 300) == pytest.approx(math.hypot(6, 16), rel=1e-6)  # 0.1 in float32
    assert largest_shift(intrinsics, torch.zeros(5), 120, 300) == 0.0


def test_the_largest_shift_may_lie_inside():
    """r radial - r = r^3 (1 - r^2 / 0.7) (1 - r^2) / 2, in a square from whose middle the border is 0.71 to 1 away."""
    a, b = 1 / 0.7, 1.0
    lens = torch.tensor([0.5, -0.5 * (a + b), 0.0, 0.0, 0.5 * a * b], dtype=torch.float64)
    half = 100 * math.sqrt(0.5)
    intrinsics = torch.tensor([[100, 0, half], [0, 100, half], [0, 0, 1]], dtype=torch.float64)
    size = round(2 * half)
    radii = np.linspace(0, 1, 10_001)
    shift = 100 * np.abs(radii**3 * (1 - a * radii**2) * (1 - b * radii**2) / 2)
    at_border = shift[radii**2 > 0.46].max()  # 0.5 and more once imaged
    assert shift.max() > 1.1 * at_border
    assert largest_shift(intrinsics, lens, size, size) == pytest.approx(shift.max(), rel=1e-3)  # places of a grid
