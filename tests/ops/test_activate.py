"""Rows as they are stored to rows as they are splatted: C++ and Triton against torch in double."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.ops.activate import activate
from sparsestreet.ops.cpu import rows as fused
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.ops.raw import LEARNED, OPACITY_LOGIT_LIMIT, Placement, Poses, RawGaussians, harmonics_of
from sparsestreet.types import Gaussians
from tests.ops.scenes import (
    CPU,
    device_of,
    every_fast_backend,
    every_fast_kind,
    fill_buffers_with_nan,
    with_threads,
)


def raw_rows(count: int, rest: int, dtype=torch.float64, seed: int = 0, device: torch.device = CPU) -> RawGaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(device, dtype).requires_grad_()

    return RawGaussians(
        normal(count, 3), normal(count, 3), normal(count, 4), normal(count), normal(count, 1, 3), normal(count, rest, 3)
    )


def placement(count: int, dtype=torch.float64, device: torch.device = CPU) -> Placement:
    generator = torch.Generator().manual_seed(1)
    turns = torch.randn(3, 4, generator=generator, dtype=torch.float64)
    shifts = 50 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    of_rows = torch.randint(3, (count,), generator=generator)
    turns, shifts = (
        values.to(device, dtype).requires_grad_() for values in (turns / turns.norm(dim=1, keepdim=True), shifts)
    )
    return Placement(Poses(turns, shifts, torch.tensor([True, False, True], device=device)), of_rows.to(device))


def closed_every_third(count: int, dtype=torch.float64, device: torch.device = CPU) -> Tensor:
    return (torch.arange(count) % 3 > 0).to(device, dtype).requires_grad_()


def inputs_of(parts: list[RawGaussians]) -> list[Tensor]:
    """Fields, multipliers and poses."""
    found = []
    for part in parts:
        shape, others = part.tensors()[:4], part.tensors()[4:LEARNED]
        found += [tensor for tensor in (*shape, part.sh_dc, part.sh_rest, *others) if tensor is not None]
    return found


def values_and_gradients(parts: list[RawGaussians], run: Callable[[list[RawGaussians]], Gaussians]) -> list[Tensor]:
    """Outputs, and the gradients of all inputs under a fixed random cotangent."""
    outputs = list(run(parts).columns().values())
    generator = torch.Generator().manual_seed(2)
    cotangents = [torch.randn(out.shape, generator=generator, dtype=torch.float64).to(out) for out in outputs]
    total = torch.stack([(out * cotangent).sum() for out, cotangent in zip(outputs, cotangents, strict=True)]).sum()
    gradients = torch.autograd.grad(total, inputs_of(parts), allow_unused=True, materialize_grads=True)
    return [*(out.detach() for out in outputs), *gradients]


def case(
    rest: int, masked: bool, placed: bool, count: int, dtype=torch.float64, device: torch.device = CPU
) -> list[RawGaussians]:
    multipliers = closed_every_third(count, dtype, device) if masked else None
    where = placement(count, dtype, device=device) if placed else None
    return [replace(raw_rows(count, rest, dtype, device=device), multipliers=multipliers, placement=where)]


def parts_of_three_kinds(dtype: torch.dtype, device: torch.device) -> list[RawGaussians]:
    """Plain rows of degree 3; none at all; masked and placed ones of degree 1."""
    plain, none = (raw_rows(*count, dtype, seed, device) for seed, count in enumerate(((70, 15), (0, 8))))
    return [plain, none, *case(3, True, True, 40, dtype, device)]


def assert_says_what_torch_says(
    backend: str, dtype: torch.dtype, degree: int, make: Callable[[torch.dtype, torch.device], list[RawGaussians]]
) -> list[Tensor]:
    """Inputs are rounded (6e-8 each in float32), products and quotients of a few of them too; returns what is found.

    The library's sums over rows are of 2500 of random signs, of which a part is added with other roundings."""
    found, expected = (
        values_and_gradients(make(*kind), lambda parts, name=name: activate(parts, sh_degree=degree, backend=name))
        for name, kind in ((backend, (dtype, device_of(backend))), ("torch", (torch.float64, CPU)))
    )
    bar = 1e-12 if dtype == torch.float64 else 1e-6 if backend == "triton" else 1e-5
    for value, truth in zip(found, expected, strict=True):
        assert (value.dtype, value.shape) == (dtype, truth.shape)
        if truth.numel():
            assert float((value.cpu().double() - truth).abs().max()) <= bar * float(truth.abs().max())
    return found


@every_fast_kind
@pytest.mark.parametrize(
    ("rest", "degree", "masked", "placed"),
    [(15, 3, True, True), (15, 2, False, False), (15, 0, True, True), (3, 1, True, False), (0, 3, False, True)],
)
def test_it_says_what_torch_says(backend, dtype, rest, degree, masked, placed):
    # More than two of the parts in which the library takes sums over rows; more than one program of a kernel.
    count = 2500 if backend == "cpu" else 150
    found = assert_says_what_torch_says(
        backend, dtype, degree, lambda *kind: case(rest, masked, placed, count, *kind)
    )  # fmt: skip
    assert found[4].shape == (count, min((degree + 1) ** 2, 1 + rest), 3)


@every_fast_kind
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_parts_stand_one_after_the_other_and_every_output_is_written(monkeypatch, backend, dtype, degree):
    fill_buffers_with_nan(monkeypatch)
    assert_says_what_torch_says(backend, dtype, degree, parts_of_three_kinds)


@every_fast_kind
@pytest.mark.parametrize("lanes", [16, 128])
def test_programs_that_hold_rows_of_some_instances_only(monkeypatch, backend, dtype, lanes):
    """Rows in the order of their instances, of which one has none; opacities tell whose are absent."""
    if backend == "triton":
        monkeypatch.setattr("sparsestreet.ops.triton.activate.LANES", lanes)
    fill_buffers_with_nan(monkeypatch)
    of_rows = torch.tensor([0] * 20 + [1] * 13 + [2] * 9 + [4] * 8)
    generator = torch.Generator().manual_seed(4)
    turns, shifts = torch.randn(5, 4, generator=generator).double(), torch.randn(5, 3, generator=generator).double()

    def placed(dtype: torch.dtype, device: torch.device) -> list[RawGaussians]:
        turned, shifted = (value.to(device, dtype, copy=True).requires_grad_() for value in (turns, shifts))
        poses = Poses(turned, shifted, torch.tensor([True, True, False, True, True], device=device))
        return [replace(raw_rows(50, 0, dtype, device=device), placement=Placement(poses, of_rows.to(device)))]

    found = assert_says_what_torch_says(backend, dtype, 0, placed)
    assert ((found[3] == 0).cpu() == (of_rows == 2)).all()
    assert not found[-1][3].any()


def test_gradients_are_those_of_finite_differences():
    inputs = inputs_of(case(3, masked=True, placed=True, count=4))

    def outputs(*values: Tensor) -> tuple[Tensor, ...]:
        where = Placement(Poses(values[7], values[8], torch.tensor([True, False, True])), torch.tensor([2, 0, 1, 0]))
        found = activate([RawGaussians(*values[:7], placement=where)], sh_degree=1, backend="cpu")
        return tuple(found.columns().values())

    assert torch.autograd.gradcheck(outputs, inputs)


@torch.no_grad()
def test_single_precision_is_good_to_its_last_digits_and_to_the_ends_of_its_range():
    """exp is off by two units in the last place at most (4 x 6e-8 = 2.4e-7), over all of its range."""
    logs = torch.linspace(-87.0, 88.0, 20001).reshape(-1, 3)
    raw = raw_rows(len(logs), 0, torch.float32)
    found = activate([replace(raw, log_scales=logs, opacity_logits=logs[:, 0] / 4)], sh_degree=0, backend="cpu")
    exact = torch.exp(logs.double())
    assert float((found.scales.double() / exact - 1).abs().max()) < 2.4e-7
    opacities = torch.sigmoid((logs[:, 0] / 4).clamp(-OPACITY_LOGIT_LIMIT, OPACITY_LOGIT_LIMIT).double())
    assert float((found.opacities.double() / opacities - 1).abs().max()) < 4e-7  # and a sum and a quotient
    ends = torch.tensor([-200.0, -103.0, -88.5, 0.0, 88.7, 89.0, 200.0, torch.inf, -torch.inf, torch.nan])
    raw = replace(raw_rows(len(ends), 0, torch.float32), log_scales=ends[:, None].expand(-1, 3))
    found, expected = (activate([raw], sh_degree=0, backend=backend).scales for backend in ("cpu", "torch"))
    # Subnormal results (below 1e-38) are good to a subnormal's last digit.
    torch.testing.assert_close(found, expected, rtol=3e-7, atol=3e-45, equal_nan=True)


@every_fast_backend
def test_logits_at_and_beyond_the_limit(backend):
    given = [16.0, 15.0, -15.5, -15.0, torch.inf, -torch.inf, torch.nan]
    answers = []
    for name in (backend, "torch"):
        device = device_of(name)
        logits = torch.tensor(given, device=device, requires_grad=True)
        raw = replace(raw_rows(len(given), 0, torch.float32, device=device), opacity_logits=logits)
        opacities = activate([raw], sh_degree=0, backend=name).opacities
        (gradient,) = torch.autograd.grad(opacities.sum(), logits)
        answers.append((opacities.detach().cpu(), gradient.cpu()))
    (opacities, gradient), (wanted, wanted_gradient) = answers
    # A GPU takes exp(x) as a power of two: x log2(e) = 22 has an ulp of 2e-6.
    torch.testing.assert_close(opacities, wanted, rtol=2e-6, atol=0.0, equal_nan=True)
    # 1 - sigmoid(15) = 3e-7 is a few ulps of 1. (Of a number that is none torch's gradient is 0; others show it.)
    torch.testing.assert_close(gradient[:-1], wanted_gradient[:-1], rtol=2e-6, atol=1.2e-7)
    assert gradient[[0, 2, 4, 5]].tolist() == [0.0] * 4
    assert bool((gradient[[1, 3]] > 0).all())


@torch.no_grad()
def test_autocast_rounds_no_position():
    """A product of matrices would be one of bfloat16 there: decimeters at 50 m."""
    parts = case(0, masked=False, placed=True, count=20, dtype=torch.float32)
    expected = activate(parts, sh_degree=0, backend="torch").means
    with torch.autocast("cpu", torch.bfloat16):
        found = activate(parts, sh_degree=0, backend="torch").means
    assert torch.equal(found, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_bits_for_any_number_of_threads(dtype):
    parts = case(15, masked=True, placed=True, count=2500, dtype=dtype)
    alone, *others = with_threads(
        (1, 2, 3), lambda: values_and_gradients(parts, lambda parts: activate(parts, sh_degree=3, backend="cpu"))
    )
    assert all(all(map(torch.equal, alone, other)) for other in others)


@pytest.mark.parametrize("variant", [0, 1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_instruction_set(variant, dtype):
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    parts = case(15, masked=True, placed=True, count=37, dtype=dtype)
    sh = harmonics_of(parts, 3)
    found = values_and_gradients(
        parts, lambda parts: Gaussians.of_learned((*fused.activate(parts, variant), *sh.tables), sh.terms)
    )
    expected = values_and_gradients(parts, lambda parts: activate(parts, sh_degree=3, backend="torch"))
    for value, truth in zip(found, expected, strict=True):
        torch.testing.assert_close(value, truth)


@every_fast_backend
def test_no_rows(backend):
    parts = case(15, True, True, 0, torch.float32, device_of(backend))
    values = values_and_gradients(parts, lambda parts: activate(parts, sh_degree=3, backend=backend))
    assert [value.shape[0] for value in values] == [0] * 12 + [3, 3]
    assert not values[-1].any()


@every_fast_backend
def test_every_tensor_is_asked_whether_it_fits(backend):
    """Multipliers and poses too; "auto" then takes torch."""
    device = device_of(backend)
    raw = raw_rows(2, 3, torch.float32, device=device)
    in_double = replace(raw, placement=placement(2, torch.float64, device=device))
    masked = replace(raw, multipliers=torch.ones(2, device=device).half())
    for refused in (in_double, masked):
        with pytest.raises(ValueError, match=r"takes .*float32.* tensors.*use backend='torch'"):
            activate([raw, refused], sh_degree=0, backend=backend)
    assert activate([raw_rows(2, 0, torch.float16)], sh_degree=0).scales.dtype == torch.float16
