"""Rows as they are stored to rows as they are splatted: C++ against torch in double, and what both promise."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.ops.activate import activate
from sparsestreet.ops.cpu import rows as fused
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.ops.raw import OPACITY_LOGIT_LIMIT, Placement, Poses, RawGaussians
from tests.ops.scenes import CPU

ROWS = 2500
"""More than two of the parts in which sums over rows are taken."""


def raw_rows(count: int, rest: int, dtype=torch.float64, seed: int = 0, device: torch.device = CPU) -> RawGaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(device, dtype).requires_grad_()

    return RawGaussians(
        normal(count, 3), normal(count, 3), normal(count, 4), normal(count), normal(count, 1, 3), normal(count, rest, 3)
    )


def placement(count: int, dtype=torch.float64, instances: int = 3, device: torch.device = CPU) -> Placement:
    generator = torch.Generator().manual_seed(1)
    turns = torch.randn(instances, 4, generator=generator, dtype=torch.float64)
    shifts = 50 * torch.randn(instances, 3, generator=generator, dtype=torch.float64)
    of_rows = torch.randint(instances, (count,), generator=generator)
    turns, shifts = (
        values.to(device, dtype).requires_grad_() for values in (turns / turns.norm(dim=1, keepdim=True), shifts)
    )
    return Placement(Poses(turns, shifts, torch.tensor([True, False, True], device=device)), of_rows.to(device))


def closed_every_third(count: int, dtype=torch.float64, device: torch.device = CPU) -> torch.Tensor:
    return (torch.arange(count) % 3 > 0).to(device, dtype).requires_grad_()


def fields_of(raw: RawGaussians) -> list[torch.Tensor]:
    return [raw.means, raw.log_scales, raw.quaternions, raw.opacity_logits, raw.sh_dc, raw.sh_rest]


def values_and_gradients(inputs: list[torch.Tensor], run) -> list[torch.Tensor]:
    """Outputs, and the gradients of all inputs under a fixed random cotangent."""
    outputs = [field for field in vars(run()).values() if field is not None]
    generator = torch.Generator().manual_seed(2)
    cotangents = [torch.randn(out.shape, generator=generator, dtype=torch.float64).to(out) for out in outputs]
    total = torch.stack([(out * cotangent).sum() for out, cotangent in zip(outputs, cotangents, strict=True)]).sum()
    gradients = torch.autograd.grad(total, inputs, allow_unused=True, materialize_grads=True)
    return [*(out.detach() for out in outputs), *gradients]


def case(
    rest: int,
    degree: int,
    masked: bool,
    placed: bool,
    dtype=torch.float64,
    count: int = ROWS,
    device: torch.device = CPU,
):
    multipliers = closed_every_third(count, dtype, device) if masked else None
    where = placement(count, dtype, device=device) if placed else None
    raw = replace(raw_rows(count, rest, dtype, device=device), multipliers=multipliers, placement=where)
    inputs = [*fields_of(raw), *([] if multipliers is None else [multipliers])]
    inputs += [] if where is None else [where.poses.quaternions, where.poses.translations]

    def run(backend: str):
        return activate([raw], sh_degree=degree, backend=backend)

    return inputs, run


@pytest.mark.parametrize(("rest", "degree"), [(0, 0), (0, 3), (3, 1), (15, 0), (15, 2), (15, 3)])
@pytest.mark.parametrize(("masked", "placed"), [(False, False), (True, False), (False, True), (True, True)])
def test_the_library_says_what_torch_says(rest, degree, masked, placed):
    inputs, run = case(rest, degree, masked, placed)
    expected = values_and_gradients(inputs, lambda: run("torch"))
    found = values_and_gradients(inputs, lambda: run("cpu"))
    assert found[4].shape == (ROWS, min((degree + 1) ** 2, 1 + rest), 3)
    for value, truth in zip(found, expected, strict=True):
        torch.testing.assert_close(value, truth, rtol=1e-12, atol=1e-12)


def parts_of_three_kinds(
    dtype=torch.float64, device: torch.device = CPU
) -> tuple[list[torch.Tensor], list[RawGaussians]]:
    """Plain rows of degree 3; none at all; masked and placed ones of degree 1."""
    where, closed = placement(40, dtype, device=device), closed_every_third(40, dtype, device)
    counts = ((70, 15), (0, 8), (40, 3))
    parts = [raw_rows(*count, dtype, seed, device) for seed, count in enumerate(counts)]
    inputs = [field for part in parts for field in fields_of(part)]
    parts[2] = replace(parts[2], multipliers=closed, placement=where)
    return [*inputs, closed, where.poses.quaternions, where.poses.translations], parts


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_parts_stand_one_after_the_other(degree):
    inputs, parts = parts_of_three_kinds()
    found = values_and_gradients(inputs, lambda: activate(parts, sh_degree=degree, backend="cpu"))
    expected = values_and_gradients(inputs, lambda: activate(parts, sh_degree=degree, backend="torch"))
    assert found[4].shape == (110, (degree + 1) ** 2, 3)
    for value, truth in zip(found, expected, strict=True):
        torch.testing.assert_close(value, truth, rtol=1e-12, atol=1e-12)
    alone = activate(parts[2:], sh_degree=degree, backend="cpu")
    assert torch.equal(found[0][70:], alone.means.detach())


def test_gradients_are_those_of_finite_differences():
    inputs, _ = case(3, 1, masked=True, placed=True, count=4)

    def outputs(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        where = Placement(Poses(values[7], values[8], torch.tensor([True, False, True])), torch.tensor([2, 0, 1, 0]))
        found = activate([RawGaussians(*values[:7], placement=where)], sh_degree=1, backend="cpu")
        return tuple(field for field in vars(found).values() if field is not None)

    assert torch.autograd.gradcheck(outputs, inputs)


@torch.no_grad()
def test_single_precision_is_good_to_its_last_digits():
    """exp is off by two units in the last place at most (4 x 6e-8 = 2.4e-7), over all of its range."""
    logs = torch.linspace(-87.0, 88.0, 20001).reshape(-1, 3)
    raw = raw_rows(len(logs), 0, torch.float32)
    raw = RawGaussians(raw.means, logs, raw.quaternions, logs[:, 0] / 4, raw.sh_dc, raw.sh_rest)
    found = activate([raw], sh_degree=0, backend="cpu")
    exact = torch.exp(logs.double())
    assert float((found.scales.double() / exact - 1).abs().max()) < 2.4e-7
    opacities = torch.sigmoid((logs[:, 0] / 4).clamp(-OPACITY_LOGIT_LIMIT, OPACITY_LOGIT_LIMIT).double())
    assert float((found.opacities.double() / opacities - 1).abs().max()) < 4e-7  # and a sum and a quotient


def test_single_precision_gradients():
    """Sums over rows are in double: only the rounding of single products remains, a few 1e-7 of the largest."""
    for masked, placed in ((False, False), (True, True)):
        inputs, run = case(15, 3, masked, placed, torch.float32)
        doubles, run_double = case(15, 3, masked, placed)
        expected = values_and_gradients(doubles, lambda run=run_double: run("torch"))
        found = values_and_gradients(inputs, lambda run=run: run("cpu"))
        for value, truth in zip(found, expected, strict=True):
            assert value.dtype == torch.float32
            error = float((value.double() - truth).abs().max() / truth.abs().max())
            # A part of the sums is added with other roundings of the inputs: 2500 rows of random signs.
            assert error < 1e-5


def test_the_ends_of_the_range():
    given = torch.tensor([-200.0, -103.0, -88.5, 0.0, 88.7, 89.0, 200.0, torch.inf, -torch.inf, torch.nan])
    n = len(given)
    raw = raw_rows(n, 0, torch.float32)
    raw = RawGaussians(raw.means, given[:, None].expand(n, 3), raw.quaternions, given, raw.sh_dc, raw.sh_rest)
    found, expected = (activate([raw], sh_degree=0, backend=backend) for backend in ("cpu", "torch"))
    # Subnormal results (below 1e-38) are good to a subnormal's last digit.
    torch.testing.assert_close(found.scales, expected.scales, rtol=3e-7, atol=3e-45, equal_nan=True)
    torch.testing.assert_close(found.opacities, expected.opacities, rtol=4e-7, atol=0.0, equal_nan=True)


@torch.no_grad()
def test_autocast_rounds_no_position():
    """A product of matrices would be one of bfloat16 there: decimeters at 50 m."""
    raw = replace(raw_rows(20, 0, torch.float32), placement=placement(20, torch.float32))
    expected = activate([raw], sh_degree=0, backend="torch").means
    with torch.autocast("cpu", torch.bfloat16):
        found = activate([raw], sh_degree=0, backend="torch").means
    assert torch.equal(found, expected)


def test_a_held_logit_gets_no_gradient():
    raw = raw_rows(3, 0)
    logits = torch.tensor([16.0, 15.0, -15.5], dtype=torch.float64, requires_grad=True)
    raw = RawGaussians(raw.means, raw.log_scales, raw.quaternions, logits, raw.sh_dc, raw.sh_rest)
    gradients = []
    for backend in ("cpu", "torch"):
        (gradient,) = torch.autograd.grad(activate([raw], sh_degree=0, backend=backend).opacities.sum(), logits)
        gradients.append(gradient.tolist())
    assert gradients[0] == gradients[1]
    assert gradients[0][0] == gradients[0][2] == 0 < gradients[0][1]


@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_bits_for_any_number_of_threads(threads, dtype):
    inputs, run = case(15, 3, masked=True, placed=True, dtype=dtype)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = values_and_gradients(inputs, lambda: run("cpu"))
        torch.set_num_threads(threads)
        shared = values_and_gradients(inputs, lambda: run("cpu"))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(alone, shared, strict=True))


@pytest.mark.parametrize("variant", [0, 1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_instruction_set(variant, dtype):
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    raw, where, closed = raw_rows(37, 15, dtype), placement(37, dtype), closed_every_third(37, dtype)
    inputs = [*fields_of(raw), closed, where.poses.quaternions, where.poses.translations]
    raw = replace(raw, multipliers=closed, placement=where)
    found = values_and_gradients(inputs, lambda: fused.activate([raw], 3, variant))
    expected = values_and_gradients(inputs, lambda: activate([raw], sh_degree=3, backend="torch"))
    for value, truth in zip(found, expected, strict=True):
        torch.testing.assert_close(value, truth)


def test_no_rows():
    inputs, run = case(15, 3, masked=True, placed=True, count=0)
    values = values_and_gradients(inputs, lambda: run("cpu"))
    assert [value.shape[0] for value in values] == [0] * 12 + [3, 3]
    assert not values[-1].any()


def test_a_backend_that_does_not_fit_is_an_error():
    raw = raw_rows(2, 0, torch.float16)
    with pytest.raises(ValueError, match=r"takes float32 or float64 tensors on the CPU.*use backend='torch'"):
        activate([raw], sh_degree=0, backend="cpu")
    with pytest.raises(ValueError, match="no backend 'cuda'"):
        activate([raw], sh_degree=0, backend="cuda")
    assert activate([raw], sh_degree=0).scales.dtype == torch.float16
