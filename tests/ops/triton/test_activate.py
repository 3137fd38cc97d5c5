"""Rows activated and placed by Triton, and their gradients, against torch in float64."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.ops.activate import activate
from sparsestreet.ops.raw import Placement, Poses
from sparsestreet.ops.triton import activate as fused
from tests.ops.scenes import CPU, device_of, fill_buffers_with_nan
from tests.ops.test_activate import (
    case,
    fields_of,
    parts_of_three_kinds,
    placement,
    raw_rows,
    values_and_gradients,
)

DEVICE = device_of("triton")
ROWS = 150
"""More than one program."""
CASES = [(rest, degree, masked, placed) for rest, degree in [(0, 3), (3, 1), (15, 0), (15, 2), (15, 3)]
         for masked, placed in [(False, False), (True, True)]]  # fmt: skip


def assert_matches_float64(found: list[torch.Tensor], expected: list[torch.Tensor]) -> None:
    """Inputs are rounded (6e-8 each), products and quotients of a few of them too."""
    assert len(found) == len(expected)
    for value, truth in zip(found, expected, strict=True):
        assert value.shape == truth.shape
        if truth.numel():
            assert float((value.cpu().double() - truth).abs().max()) <= 1e-6 * float(truth.abs().max())


def results(rest: int, degree: int, masked: bool, placed: bool) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    answers = []
    for backend, dtype, device in (("triton", torch.float32, DEVICE), ("torch", torch.float64, CPU)):
        inputs, run = case(rest, degree, masked, placed, dtype, ROWS, device)
        answers.append(values_and_gradients(inputs, lambda run=run, backend=backend: run(backend)))
    return tuple(answers)


@pytest.mark.parametrize(("rest", "degree", "masked", "placed"), [*CASES, (3, 1, True, False), (0, 0, False, True)])
def test_it_says_what_torch_says(rest, degree, masked, placed):
    assert_matches_float64(*results(rest, degree, masked, placed))


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_parts_stand_one_after_the_other_and_every_output_is_written(monkeypatch, degree):
    fill_buffers_with_nan(monkeypatch)
    answers = []
    for backend, dtype, device in (("triton", torch.float32, DEVICE), ("torch", torch.float64, CPU)):
        inputs, parts = parts_of_three_kinds(dtype, device)

        def run(parts=parts, backend=backend):
            return activate(parts, sh_degree=degree, backend=backend)

        answers.append(values_and_gradients(inputs, run))
    assert_matches_float64(*answers)


@pytest.mark.parametrize("lanes", [16, 128])
def test_programs_that_hold_rows_of_some_instances_only(monkeypatch, lanes):
    """Rows in the order of their instances, of which one has none; opacities tell whose are absent."""
    monkeypatch.setattr(fused, "LANES", lanes)
    fill_buffers_with_nan(monkeypatch)
    of_rows = torch.tensor([0] * 20 + [1] * 13 + [2] * 9 + [4] * 8)
    generator = torch.Generator().manual_seed(4)
    turns, shifts = torch.randn(5, 4, generator=generator).double(), torch.randn(5, 3, generator=generator).double()
    answers = []
    for backend, dtype, device in (("triton", torch.float32, DEVICE), ("torch", torch.float64, CPU)):
        raw = raw_rows(len(of_rows), 0, dtype, device=device)
        leaves = [value.to(device, dtype, copy=True).requires_grad_() for value in (turns, shifts)]
        poses = Poses(leaves[0], leaves[1], torch.tensor([True, True, False, True, True], device=device))
        inputs = [*fields_of(raw), *leaves]
        raw = replace(raw, placement=Placement(poses, of_rows.to(device)))

        def run(raw=raw, backend=backend):
            return activate([raw], sh_degree=0, backend=backend)

        assert ((run().opacities == 0).cpu() == (of_rows == 2)).all()
        answers.append(values_and_gradients(inputs, run))
    assert not answers[0][-1][3].any()
    assert_matches_float64(*answers)


def test_logits_at_and_beyond_the_limit():
    given = [16.0, 15.0, -15.5, -15.0, torch.inf, -torch.inf, torch.nan]
    answers = []
    for backend, device in (("triton", DEVICE), ("torch", CPU)):
        raw = raw_rows(len(given), 0, torch.float32, device=device)
        logits = torch.tensor(given, device=device, requires_grad=True)
        opacities = activate([replace(raw, opacity_logits=logits)], sh_degree=0, backend=backend).opacities
        (gradient,) = torch.autograd.grad(opacities.sum(), logits)
        answers.append((opacities.detach().cpu(), gradient.cpu()))
    (opacities, gradient), (wanted, wanted_gradient) = answers
    # A GPU takes exp(x) as a power of two: x log2(e) = 22 has an ulp of 2e-6.
    torch.testing.assert_close(opacities, wanted, rtol=2e-6, atol=0.0, equal_nan=True)
    # 1 - sigmoid(15) = 3e-7 is a few ulps of 1. The number that is none shows in the gradient, too (in torch it is 0).
    torch.testing.assert_close(gradient[:-1], wanted_gradient[:-1], rtol=2e-6, atol=1.2e-7)
    assert gradient[[0, 2, 4, 5]].tolist() == [0.0] * 4
    assert bool((gradient[[1, 3]] > 0).all())
    assert bool(gradient[6].isnan())


def test_coefficients_that_are_not_used_get_no_gradient():
    raw = raw_rows(3, 15, torch.float32, device=DEVICE)
    sh = activate([raw], sh_degree=0, backend="triton").sh
    v_dc, v_rest = torch.autograd.grad(sh.sum(), (raw.sh_dc, raw.sh_rest), allow_unused=True)
    assert v_dc.tolist() == [[[1.0] * 3]] * 3
    assert v_rest is None
    (v_rest,) = torch.autograd.grad(activate([raw], sh_degree=1, backend="triton").sh.sum(), raw.sh_rest)
    assert v_rest.sum((0, 2)).tolist() == [9.0] * 3 + [0.0] * 12


def test_no_rows():
    inputs, run = case(15, 3, True, True, torch.float32, 0, DEVICE)
    values = values_and_gradients(inputs, lambda: run("triton"))
    assert [value.shape[0] for value in values] == [0] * 12 + [3, 3]
    assert not values[-1].any()


def test_tensors_of_another_kind_are_refused():
    raw = raw_rows(2, 3, torch.float32, device=DEVICE)
    in_double = replace(raw, placement=placement(2, torch.float64, device=DEVICE))
    strided = replace(raw, multipliers=torch.ones(4, device=DEVICE)[::2])
    for refused in (in_double, strided):
        with pytest.raises(ValueError, match=r"'triton' takes contiguous float32 tensors.*use backend='torch'"):
            activate([raw, refused], sh_degree=0, backend="triton")
