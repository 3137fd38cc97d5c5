"""The sky behind an image: every backend against torch in float64, at sizes that the interpreter bears."""

import dataclasses
from functools import partial
from types import ModuleType

import pytest
import torch
from torch import Tensor

from sparsestreet.geometry.quaternions import from_rotation_vector, to_matrix
from sparsestreet.ops import over_sky
from sparsestreet.ops import sky as torch_sky
from sparsestreet.ops.cpu import images as cpu
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.ops.cube_map import colors_along
from sparsestreet.phases import PhaseRecorder, WallClock
from sparsestreet.types import Camera
from tests.ops.scenes import device_of, every_fast_precision, fill_buffers_with_nan, relative_error, with_threads

NAMES = ("rgb", "alpha", "texels")
LIMIT = 0.25
"""Of the light; in binary, as are the alphas about it."""


def camera(width: int, height: int, seed: int = 0) -> Camera:
    """Wide enough to see five faces of the cube, turned anywhere, its principal point off the center."""
    focal = 0.3 * max(width, height)
    intrinsics = torch.tensor([[focal, 0, 0.47 * width], [0, 1.1 * focal, 0.54 * height], [0, 0, 1]]).double()
    pose = torch.eye(4, dtype=torch.float64)
    turn = 3 * torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    pose[:3, :3] = to_matrix(from_rotation_vector(turn))
    return Camera(pose, intrinsics, width, height)


def with_lens(view: Camera) -> Camera:
    return dataclasses.replace(view, distortion=torch.tensor([0.1, -0.02, 1e-3, 2e-3, 0.0]).double())


def image(view: Camera, side: int, seed: int = 1) -> dict[str, Tensor]:
    """Float32 values in float64; a third of the alphas are 0, 1, or at the limit and beside it."""
    generator = torch.Generator().manual_seed(seed)
    shape = (view.height, view.width)
    alpha = torch.rand(shape, generator=generator).flatten()
    special = torch.tensor([0.0, 1.0, 1 - LIMIT, 1 - LIMIT - 2**-20, 1 - LIMIT + 2**-20])
    alpha[::3] = special[torch.randint(5, alpha[::3].shape, generator=generator)]
    rgb, texels = torch.rand(*shape, 3, generator=generator), torch.rand(6, side, side, 3, generator=generator)
    return {"rgb": rgb.double(), "alpha": alpha.reshape(shape).double(), "texels": texels.double()}


def answer(
    given: dict[str, Tensor], view: Camera, backend: str, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, dict[str, Tensor]]:
    """The image and the gradients with the same random cotangent for every backend, on the CPU, in float64."""
    device = device_of(backend)
    leaves = {name: value.to(device, dtype, copy=True).requires_grad_() for name, value in given.items()}
    out = over_sky(**leaves, camera=view, transmittance_min=LIMIT, backend=backend)
    cotangent = torch.randn(out.shape, generator=torch.Generator().manual_seed(2)).to(device, dtype)
    out.backward(cotangent)
    return out.detach().double().cpu(), {name: leaves[name].grad.double().cpu() for name in NAMES}


def assert_matches_torch(given: dict[str, Tensor], view: Camera, backend: str, dtype: torch.dtype) -> None:
    wanted, wanted_gradients = answer(given, view, "torch")
    out, gradients = answer(given, view, backend, dtype)
    # A direction is off by up to 4 eps of its largest component (far from the image's center the terms of its product
    # are larger than it is), which is half a face of texels; and texels differ by 1 at most, along two axes.
    bound = 4 * (1 + given["texels"].shape[1]) * torch.finfo(dtype).eps
    assert (out - wanted).abs().max() <= bound
    assert torch.equal(gradients["rgb"], wanted_gradients["rgb"])
    # Each is a sum of a few such errors, over the length of what has no error in common.
    for name in ("alpha", "texels"):
        assert relative_error(gradients[name], wanted_gradients[name]) <= 2 * bound, name


@every_fast_precision
@pytest.mark.parametrize(("width", "height", "side"), [(1, 1, 2), (9, 7, 1), (16, 8, 2), (13, 29, 5), (131, 3, 128)])
@pytest.mark.parametrize("lens", [False, True])
def test_random_images(backend, dtype, width, height, side, lens):
    """One pixel; one texel a face; one program of the kernels; several, the last of them in part."""
    for seed in range(3):
        view = camera(width, height, seed)
        assert_matches_torch(image(view, side, seed), with_lens(view) if lens else view, backend, dtype)


@every_fast_precision
@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_all_sky_and_none(monkeypatch, backend, dtype, alpha):
    """Every output is written: buffers hold NaN before."""
    view = camera(11, 7)
    given = image(view, 5) | {"alpha": torch.full((7, 11), alpha).double()}
    fill_buffers_with_nan(monkeypatch)
    if alpha == 0:
        assert_matches_torch(given, view, backend, dtype)
        return
    out, gradients = answer(given, view, backend, dtype)
    assert torch.equal(out, given["rgb"])
    assert not gradients["alpha"].any()
    assert not gradients["texels"].any()


@every_fast_precision
def test_light_at_the_limit_is_not_seen(backend, dtype):
    view = camera(5, 1)
    alpha = 1 - LIMIT + torch.tensor([[-0.25, -(2**-24), 0.0, 2**-24, 0.25]]).double()
    given = image(view, 2) | {"alpha": alpha}
    out, gradients = answer(given, view, backend, dtype)
    assert ((out - given["rgb"]) != 0).any(-1).tolist() == [[True, True, False, False, False]]
    assert (gradients["alpha"] != 0).tolist() == [[True, True, False, False, False]]


@every_fast_precision
@pytest.mark.parametrize("side", [1, 2, 5])
@pytest.mark.parametrize("degrees", [0.0, 45.0])
def test_at_edges_and_corners_of_the_cube(backend, dtype, side, degrees):
    """Nine pixels that look at the middle of a face, its edges and its corners, where rounding decides which face is
    looked up: all of them give the same color, and a gradient to the same texels."""
    intrinsics = torch.tensor([[1.0, 0, 1.5], [0, 1, 1.5], [0, 0, 1]]).double()
    for axis in torch.eye(3).double():
        pose = torch.eye(4).double()
        pose[:3, :3] = to_matrix(from_rotation_vector(torch.deg2rad(torch.tensor(degrees).double()) * axis))
        view = Camera(pose, intrinsics, 3, 3)
        given = image(view, side)
        assert_matches_torch(given | {"alpha": 0.5 * given["alpha"]}, view, backend, dtype)


@every_fast_precision
def test_a_lens_is_asked_for_its_rays_and_a_pinhole_is_not(monkeypatch, backend, dtype):
    other = torch.randn(7, 9, 3, generator=torch.Generator().manual_seed(3)).double()
    plain, view = camera(9, 7), with_lens(camera(9, 7))
    given = image(view, 5)
    before = answer(given, plain, backend, dtype)[0]
    for module in modules(backend):
        monkeypatch.setattr(module, "ray_directions", lambda *_: other)
    assert_matches_torch(given, view, backend, dtype)
    assert torch.equal(answer(given, plain, backend, dtype)[0], before)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
def test_a_lens_shows_the_sky_along_its_rays(backend):
    """Found by the fixed point of x = (x_d - tangential) / radial."""
    k1, k2, p1, p2, k3 = lens = [-0.2, 0.05, 2e-3, -1e-3, -0.01]
    intrinsics = torch.tensor([[8.0, 0, 4.2], [0, 8, 3.8], [0, 0, 1]], dtype=torch.float64)
    plain = dataclasses.replace(camera(9, 7), intrinsics=intrinsics)
    y, x = torch.meshgrid((torch.arange(7).double() - 3.3) / 8, (torch.arange(9).double() - 3.7) / 8, indexing="ij")
    imaged = torch.stack((x, y), -1)
    for _ in range(100):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            (imaged[..., 0] - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
            (imaged[..., 1] - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    directions = torch.stack((x, y, torch.ones_like(x)), -1) @ plain.camera_from_world[:3, :3]
    given = image(plain, 5) | {"alpha": torch.zeros(7, 9).double()}
    sky = colors_along(given["texels"], directions.reshape(63, 3)).reshape(7, 9, 3)
    view = dataclasses.replace(plain, distortion=torch.tensor(lens, dtype=torch.float64))
    # The inverse is exact to rounding, and texels differ by 1 at most.
    torch.testing.assert_close(answer(given, view, backend)[0], given["rgb"] + sky, atol=1e-12, rtol=0)
    assert (answer(given, plain, backend)[0] - given["rgb"] - sky).abs().max() > 0.01


def modules(backend: str) -> list[ModuleType]:
    """Those that ask for rays."""
    if backend == "cpu":
        return [torch_sky, cpu]
    from sparsestreet.ops.triton import sky as triton

    return [torch_sky, triton]


@every_fast_precision
def test_rays_that_are_no_numbers_read_nothing_outside(monkeypatch, backend, dtype):
    view = with_lens(camera(9, 7))
    rays = torch.full((7, 9, 3), torch.nan).double()
    least = torch.finfo(dtype).smallest_normal * torch.finfo(dtype).eps
    rays[:3], rays[3], rays[4] = torch.inf, 0.0, least * torch.tensor([1.0, -1.0, -1.0])
    monkeypatch.setattr(modules(backend)[1], "ray_directions", lambda *_: rays)
    out, gradients = answer(image(view, 128), view, backend, dtype)
    assert out.shape == (7, 9, 3)
    assert gradients["texels"].isfinite().all()


@every_fast_precision
def test_views_of_tensors_and_a_cotangent_without_strides(backend, dtype):
    view = camera(7, 9)
    given = image(view, 3)
    results = []
    for turn in (False, True):
        leaves = {
            name: value.to(device_of(backend), dtype, copy=True).requires_grad_() for name, value in given.items()
        }
        mirrored = {name: leaf.transpose(0, 1).contiguous().transpose(0, 1) for name, leaf in leaves.items()}
        out = over_sky(**(mirrored if turn else leaves), camera=view, transmittance_min=LIMIT, backend=backend)
        out.sum().backward()
        results.append([out.detach(), *(leaf.grad for leaf in leaves.values())])
    # Triton's atomics add in any order.
    for plain, other in zip(*results, strict=True):
        torch.testing.assert_close(plain, other, atol=1e-5 if backend == "triton" else 0, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_bits_for_any_number_of_threads(dtype):
    """Many pixels to few texels: in another order, their sums would differ."""
    view = camera(65, 83)
    given = image(view, 5)

    def bits() -> list[Tensor]:
        out, gradients = answer(given, view, "cpu", dtype)
        return [out, *gradients.values()]

    alone, *others = with_threads((1, 2, 3), bits)
    for other in others:
        assert all(torch.equal(a, b) for a, b in zip(alone, other, strict=True))


@pytest.mark.parametrize("variant", [0, 1, 2])
def test_every_instruction_set(monkeypatch, variant):
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    run = cpu.over_sky
    monkeypatch.setattr(cpu, "over_sky", partial(run, variant=variant))
    view = camera(13, 29)
    for dtype in (torch.float32, torch.float64):
        assert_matches_torch(image(view, 5), view, "cpu", dtype)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("lens", [False, True])
def test_finite_differences(backend, lens):
    view = with_lens(camera(4, 3)) if lens else camera(4, 3)
    given = image(view, 2)
    given["alpha"] = given["alpha"].clamp(0.1, 0.7)  # a step must not cross the limit

    def out(rgb: Tensor, alpha: Tensor, texels: Tensor) -> Tensor:
        return over_sky(rgb, alpha, texels, view, transmittance_min=LIMIT, backend=backend)

    assert torch.autograd.gradcheck(out, [given[name].requires_grad_() for name in NAMES])


@every_fast_precision
@pytest.mark.parametrize("name", NAMES)
def test_one_gradient_alone(backend, dtype, name):
    view = camera(9, 7)
    given = image(view, 3)
    tensors = {key: value.to(device_of(backend), dtype, copy=True) for key, value in given.items()}
    tensors[name].requires_grad_()
    out = over_sky(**tensors, camera=view, transmittance_min=LIMIT, backend=backend)
    out.backward(torch.randn(out.shape, generator=torch.Generator().manual_seed(2)).to(out))
    wanted = answer(given, view, backend, dtype)[1][name]
    torch.testing.assert_close(tensors[name].grad.cpu().double(), wanted, atol=1e-5 * (backend == "triton"), rtol=0)


def test_the_backward_pass_is_a_phase():
    recorder = PhaseRecorder(WallClock())
    recorder.start()
    answer(image(camera(9, 7), 3), camera(9, 7), "cpu")
    assert "sky backward" in recorder.stop()


@pytest.mark.parametrize(
    ("changes", "backend", "said"),
    [
        ({"camera": camera(8, 7)}, "auto", r"rgb must have shape \[7, 8, 3\] for an image of 8x7 pixels"),
        ({"texels": torch.zeros(6, 0, 0, 3)}, "auto", r"texels must have shape \[6, 1, 1, 3\]"),
        ({"alpha": torch.zeros(7, 9).double()}, "auto", "share one dtype and device"),
        ({"camera": dataclasses.replace(camera(9, 7), intrinsics=-torch.eye(3))}, "auto", "positive focal lengths"),
        ({}, "reference", r"choose one of \('auto', 'torch', 'cpu', 'triton'\)"),
    ],
)
def test_what_does_not_fit_is_an_error(changes, backend, said):
    view = camera(9, 7)
    given = {name: value.float() for name, value in image(view, 3).items()} | {"camera": view} | changes
    with pytest.raises(ValueError, match=said):
        over_sky(**given, transmittance_min=LIMIT, backend=backend)
