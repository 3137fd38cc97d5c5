"""Small scenes for the tests of the op, and ways to render and differentiate them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.backend import has_triton
from sparsestreet.ops.cpu.library import find_library, idle_workspaces
from sparsestreet.types import Camera, Gaussians

Answer = TypeVar("Answer")
FIELDS = ("means", "quaternions", "scales", "opacities", "sh")
DEFAULT = SplatSettings()
CPU = torch.device("cpu")
BACKENDS = ("reference", *["cpu"] * (find_library() is not None), *["triton"] * has_triton())
"""Every implementation of the op that is here; ``test_cpu_library.py`` fails without the C++ library. What is tested
for all takes its list from here, so that a new case runs on each. Triton's kernels run by its interpreter where
there is no GPU; what is too much for that in ``make test`` has the marker ``slow_if_interpreted`` and waits for
``make test-all``."""
SINGLE_PRECISION = ("triton",)
"""Those that compute in float32 only; tests whose oracle needs float64 leave them out."""


def device_of(backend: str) -> torch.device:
    """Where a backend is tested: "triton" on a GPU if there is one, else on the CPU by Triton's interpreter."""
    return torch.device("cuda") if backend == "triton" and torch.cuda.is_available() else CPU


def _dtypes(backend: str) -> tuple[torch.dtype, ...]:
    return (torch.float32,) if backend in SINGLE_PRECISION else (torch.float32, torch.float64)


def _each(backends: tuple[str, ...], *, in_every_precision: bool, doubles_wait: bool = True) -> pytest.MarkDecorator:
    """Float64 waits for ``make test-all`` where float32, in which training runs, is tested as well."""
    cases = []
    for backend in backends:
        marks = [pytest.mark.interpreted] * (backend == "triton" and device_of(backend) == CPU)
        if in_every_precision:
            for dtype in _dtypes(backend):
                name = f"{backend}-{str(dtype).removeprefix('torch.')}"
                other = [pytest.mark.slow] * (dtype == torch.float64 and doubles_wait)
                cases.append(pytest.param(backend, dtype, marks=[*marks, *other], id=name))
        else:
            cases.append(pytest.param(backend, marks=marks))
    return pytest.mark.parametrize(("backend", "dtype") if in_every_precision else "backend", cases)


_FAST_BACKENDS = tuple(name for name in BACKENDS if name != "reference")
_DOUBLE_BACKENDS = tuple(name for name in BACKENDS if torch.float64 in _dtypes(name))
every_backend = _each(BACKENDS, in_every_precision=False)
every_precision = _each(BACKENDS, in_every_precision=True)
every_double = _each(_DOUBLE_BACKENDS, in_every_precision=False)
every_fast_backend = _each(_FAST_BACKENDS, in_every_precision=False)
every_fast_precision = _each(_FAST_BACKENDS, in_every_precision=True)
every_fast_kind = _each(_FAST_BACKENDS, in_every_precision=True, doubles_wait=False)
"""Of quick tests."""


def first_interpreted(first: Any, *others: Any) -> list[Any]:
    """Values of a parameter of which Triton's interpreter takes the first; the others wait for ``make test-all``."""
    return [first, *(pytest.param(value, marks=pytest.mark.slow_if_interpreted) for value in others)]


def camera(width: int, height: int, dtype: torch.dtype = torch.float64, focal: float | None = None) -> Camera:
    """A turned and shifted camera, its principal point off the center."""
    focal = float(width) if focal is None else focal
    intrinsics = torch.tensor([[focal, 0, 0.47 * width], [0, 1.1 * focal, 0.54 * height], [0, 0, 1]], dtype=dtype)
    angle = torch.tensor(0.3, dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = angle.cos()
    pose[0, 2], pose[2, 0] = angle.sin(), -angle.sin()
    pose[:3, 3] = torch.tensor([0.5, -0.2, 0.3])
    return Camera(pose.to(dtype), intrinsics, width, height)


def front_camera(width: int, height: int, focal: float, dtype: torch.dtype = torch.float64) -> Camera:
    """At the origin, looking along +z, principal point in the middle."""
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=dtype)
    return Camera(torch.eye(4, dtype=dtype), intrinsics, width, height)


def random_gaussians(rows: int, view: Camera, terms: int = 4, seed: int = 0) -> Gaussians:
    """Float64 rows that hold float32 values (so both precisions see the same scene): some behind, some off screen."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    depth = 25 * uniform(rows) - 3
    reach = 1.4 * depth.abs() / float(view.intrinsics[0, 0])
    x = (uniform(rows) - 0.5) * reach * view.width
    y = (uniform(rows) - 0.5) * reach * view.height
    pose = view.camera_from_world.double()
    means = (torch.stack((x, y, depth), -1) - pose[:3, 3]) @ pose[:3, :3]
    sigma_pixels = 2.5 * torch.exp(0.6 * torch.randn(rows, 3, generator=generator, dtype=torch.float64))
    parts = (
        means,
        torch.randn(rows, 4, generator=generator, dtype=torch.float64),
        sigma_pixels * depth.abs()[:, None] / float(view.intrinsics[0, 0]),
        0.02 + 0.98 * uniform(rows),
        0.5 * torch.randn(rows, terms, 3, generator=generator, dtype=torch.float64),
    )
    return Gaussians(*(part.float().double() for part in parts))


def one_gaussian(**fields: list) -> Gaussians:
    """A gray ball of 0.1 m two meters ahead, with fields replaced; float64."""
    values = {
        "means": [[0.0, 0.0, 2.0]],
        "quaternions": [[1.0, 0.0, 0.0, 0.0]],
        "scales": [[0.1, 0.1, 0.1]],
        "opacities": [0.8],
        "sh": [[[0.0, 0.0, 0.0]]],
    } | fields
    return Gaussians(*(torch.tensor(values[name], dtype=torch.float64) for name in FIELDS))


def cast(
    gaussians: Gaussians, dtype: torch.dtype, requires_grad: bool = False, device: torch.device = CPU
) -> Gaussians:
    """Detached copy in another precision; displacements never ask for a gradient."""
    moved = gaussians.displacements
    fields = (getattr(gaussians, name).detach().clone().to(device, dtype) for name in FIELDS)
    copy = Gaussians(*(field.requires_grad_(requires_grad) for field in fields))
    return copy if moved is None else replace(copy, displacements=moved.detach().to(device, dtype))


def cotangents(view: Camera, seed: int = 5) -> tuple[Tensor, Tensor, Tensor]:
    """Random upstream gradients of rgb, alpha and depth; the depth's smaller, as meters are larger than colors."""
    generator = torch.Generator().manual_seed(seed)
    shape = (view.height, view.width)
    rgb = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    alpha = torch.randn(shape, generator=generator, dtype=torch.float64)
    depth = 0.05 * torch.randn(shape, generator=generator, dtype=torch.float64)
    return rgb, alpha, depth


@dataclass(frozen=True)
class Result:
    """Images and gradients of one rendering, in float64."""

    images: dict[str, Tensor]
    gradients: dict[str, Tensor]
    radii: Tensor

    def is_finite(self) -> bool:
        tensors = [*self.images.values(), *self.gradients.values()]
        return all(bool(torch.isfinite(tensor).all()) for tensor in tensors)


def render(
    gaussians: Gaussians,
    view: Camera,
    backend: str,
    dtype: torch.dtype = torch.float64,
    settings: SplatSettings = DEFAULT,
    background: Tensor | None = None,
) -> Result:
    """Forward and backward with the same random cotangents for every backend; the result is on the CPU."""
    device = device_of(backend)
    leaves = cast(gaussians, dtype, requires_grad=True, device=device)
    behind = None if background is None else background.detach().clone().to(device, dtype).requires_grad_()
    rendering = splat(leaves, view, background=behind, settings=settings, backend=backend)
    images = {"rgb": rendering.rgb, "alpha": rendering.alpha, "depth": rendering.depth}
    torch.autograd.backward(list(images.values()), [v.to(device, dtype) for v in cotangents(view)])
    gradients = {name: getattr(leaves, name).grad for name in FIELDS} | {"screen": rendering.screen_offsets.grad}
    if behind is not None:
        gradients["background"] = behind.grad
    return Result(
        {name: image.detach().double().cpu() for name, image in images.items()},
        {name: gradient.double().cpu() for name, gradient in gradients.items()},
        rendering.radii.double().cpu(),
    )


def relative_error(value: Tensor, truth: Tensor) -> float:
    """L2 of the difference over L2 of the truth."""
    return float((value - truth).norm() / truth.norm().clamp(min=1e-30))


def with_threads(counts: tuple[int, ...], call: Callable[[], Answer]) -> list[Answer]:
    """What ``call`` answers with each number of threads."""
    before, results = torch.get_num_threads(), []
    try:
        for count in counts:
            torch.set_num_threads(count)
            results.append(call())
    finally:
        torch.set_num_threads(before)
    return results


def fill_buffers_with_nan(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is allocated without a value holds NaN, or its largest whole number, from now on; so do idle workspaces."""

    def filled(empty: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def call(*arguments, **options) -> Tensor:
            tensor = empty(*arguments, **options)
            if tensor.is_floating_point() or tensor.dtype == torch.bool:
                return tensor.fill_(torch.nan)
            return tensor.fill_(torch.iinfo(tensor.dtype).max)

        return call

    for workspace in idle_workspaces():
        workspace.poison()
    for owner, name in ((torch, "empty"), (torch, "empty_like"), (torch.Tensor, "new_empty")):
        monkeypatch.setattr(owner, name, filled(getattr(owner, name)))
