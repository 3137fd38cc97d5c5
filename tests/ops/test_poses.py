"""Poses of moving objects: C++ and Triton against torch in double, at every kind of place between two keyframes."""

import pytest
import torch

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.ops.cpu import rows as fused
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.ops.poses import poses_at
from tests.ops.scenes import device_of, every_backend, every_fast_backend, every_fast_kind, fill_buffers_with_nan

MAX_GAP = 0.15
Deltas = tuple[torch.Tensor, torch.Tensor]
"""Corrections of rotations and of translations."""
TIMES = [0.0, 0.05, 0.1, 0.15, 0.2, 0.35, 0.5, 0.9, 1.0]


def tables(dtype=torch.float64, seed: int = 0, size: float = 0.3) -> tuple[Trajectories, Deltas]:
    """Instances with 5, 2 and 1 keyframes, one that hardly turns, one that turns by more than half a circle and one
    whose quaternion changes its sign; with corrections."""
    generator = torch.Generator().manual_seed(seed)
    counts = [5, 2, 1, 5, 5, 5]
    turns = torch.randn(6, 5, 4, generator=generator, dtype=torch.float64)
    turns[3] = turns[3, :1] + 1e-3 * turns[3]
    turns = turns / turns.norm(dim=-1, keepdim=True)
    turns[5, 1::2] = -turns[5, :1] + 0.1 * turns[5, 1::2]
    turns = turns / turns.norm(dim=-1, keepdim=True)
    times = torch.tensor([0.1, 0.2, 0.3, 0.7, 0.8], dtype=torch.float64).repeat(6, 1)
    valid = torch.arange(5) < torch.tensor(counts)[:, None]
    spans = torch.tensor([[0.0, 1.0], [0.1, 0.25], [0.1, 0.1], [0.1, 0.8], [0.05, 0.95], [0.1, 0.8]])
    shifts = 20 * torch.randn(6, 5, 3, generator=generator, dtype=torch.float64)
    turned, shifted = (size * torch.randn(6, 5, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    table = Trajectories(
        torch.where(valid, times, 0.0).to(dtype), turns.to(dtype), shifts.to(dtype), valid, spans.to(dtype)
    )
    return table, (turned.to(dtype).requires_grad_(), shifted.to(dtype).requires_grad_())


def in_double(table: Trajectories) -> Trajectories:
    return Trajectories(*(v.cpu().double() if v.is_floating_point() else v.cpu() for v in vars(table).values()))


def values_and_gradients(deltas, run) -> list[torch.Tensor]:
    found = run()
    generator = torch.Generator().manual_seed(1)
    cotangents = [torch.randn(v.shape, generator=generator, dtype=torch.float64).to(v) for v in found[:2]]
    total = torch.stack([(v * c).sum() for v, c in zip(found[:2], cotangents, strict=True)]).sum()
    return [*(v.detach() for v in found), *torch.autograd.grad(total, deltas)]


def on_device(backend: str, dtype: torch.dtype, size: float = 0.3) -> tuple[Trajectories, Deltas]:
    table, (turned, shifted) = tables(dtype, size=size)
    device = device_of(backend)
    turned, shifted = (delta.detach().to(device, copy=True).requires_grad_() for delta in (turned, shifted))
    return Trajectories(*(value.to(device) for value in vars(table).values())), (turned, shifted)


def posed(table: Trajectories, deltas: Deltas, time: float, backend: str) -> tuple[torch.Tensor, ...]:
    return tuple(vars(poses_at(table, *deltas, time, MAX_GAP, backend=backend)).values())


def assert_says_what_torch_says(backend: str, dtype: torch.dtype, time: float, size: float) -> None:
    table, deltas = on_device(backend, dtype, size)
    turned, shifted = (delta.detach().cpu().double().requires_grad_() for delta in deltas)
    doubles = turned, shifted
    found = values_and_gradients(deltas, lambda: posed(table, deltas, time, backend))
    # The time itself is rounded as those of the table.
    rounded = float(torch.tensor(time, dtype=dtype))
    expected = values_and_gradients(doubles, lambda: posed(in_double(table), doubles, rounded, "torch"))
    assert found[2].tolist() == expected[2].tolist()
    # In float32 two units in the last place of numbers from 2 to 4: a pose at twice the way between two keyframes
    # doubles the rounding of both, and a device contracts what the interpreter rounds twice. Gradients are of size 1 to
    # 3. The branches near equal rotations and near zero vectors are approximations, the same in all.
    bars = (1e-11, 1e-9, 0.0, 1e-10, 1e-10) if dtype == torch.float64 else (5e-7, 1e-5, 0.0, 2e-6, 5e-7)
    for value, truth, bar in zip(found, expected, bars, strict=True):
        torch.testing.assert_close(value.cpu().double(), truth.double(), rtol=0.0, atol=bar)


@every_fast_kind
@pytest.mark.parametrize("time", [0.05, 0.1, 0.17, 0.53, 0.9])
@pytest.mark.parametrize("size", [0.0, 1e-4, 0.3, 3.0])
def test_it_says_what_torch_says(monkeypatch, backend, dtype, time, size):
    """Turns near zero and beyond half a circle, times outside of spans and too far from any keyframe; many programs."""
    if backend == "triton":
        monkeypatch.setattr("sparsestreet.ops.triton.poses.LANES", 4)
    fill_buffers_with_nan(monkeypatch)
    assert_says_what_torch_says(backend, dtype, time, size)


def test_gradients_are_those_of_finite_differences():
    table, deltas = tables()

    def outputs(turned: torch.Tensor, shifted: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found = poses_at(table, turned, shifted, 0.26, MAX_GAP, backend="cpu")
        return found.quaternions, found.translations

    assert torch.autograd.gradcheck(outputs, deltas)


@pytest.mark.parametrize("variant", [0, 1, 2])
def test_single_precision_is_good_to_its_last_digit(variant):
    """Computed in double and rounded once: half a unit in the last place of the result, of 50 m and of 1."""
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    table, deltas = tables(torch.float32)
    doubles = in_double(table)
    for time in TIMES:
        found = fused.poses_at(table, *deltas, time, MAX_GAP, variant)
        # The time itself is rounded as those of the table.
        at = float(torch.tensor(time))
        truth = fused.poses_at(doubles, deltas[0].double(), deltas[1].double(), at, MAX_GAP)
        assert found[2].tolist() == truth[2].tolist()
        torch.testing.assert_close(found[0].double(), truth[0], rtol=0.0, atol=6e-8)
        torch.testing.assert_close(found[1].double(), truth[1], rtol=6e-8, atol=1e-7)


@every_backend
@pytest.mark.parametrize(("time", "present"), [(0.05, False), (0.6, True), (0.62, False)])
def test_padding_is_no_keyframe_and_equal_distances_may_differ_by_rounding(backend, time, present):
    """One keyframe at 0.5; in float32 0.6 is farther from it than 0.1: a car would be gone for a frame."""
    backend = "torch" if backend == "reference" else backend
    table, deltas = on_device(backend, torch.float32)
    times, valid = torch.zeros_like(table.times), torch.zeros_like(table.valid)
    times[:, 0], valid[:, 0] = 0.5, True
    spans = torch.tensor([[0.0, 1.0]]).repeat(6, 1).to(times)
    table = Trajectories(times, table.quaternions, table.translations, valid, spans)
    assert poses_at(table, *deltas, time, 0.1, backend=backend).present.tolist() == [present] * 6


def test_quaternions_are_unit_and_agree_with_their_keyframes():
    table, deltas = tables(size=0.0)
    found = poses_at(table, *deltas, 0.3, MAX_GAP)
    matrices = quat.to_matrix(table.quaternions[:, 2])
    torch.testing.assert_close(quat.to_matrix(found.quaternions)[[0, 3, 4, 5]], matrices[[0, 3, 4, 5]])
    torch.testing.assert_close(found.quaternions.norm(dim=1), torch.ones(6, dtype=torch.float64))


@every_fast_backend
def test_only_one_output_is_differentiated(backend):
    table, deltas = on_device(backend, torch.float32)
    for field, moved, resting in (("quaternions", 0, 1), ("translations", 1, 0)):
        poses = poses_at(table, *deltas, 0.26, MAX_GAP, backend=backend)
        gradients = torch.autograd.grad(getattr(poses, field).sum(), deltas)
        assert gradients[moved].any()
        assert not gradients[resting].any()


@every_fast_backend
def test_no_instances(backend):
    table, deltas = on_device(backend, torch.float32)
    none = Trajectories(*(values[:0] for values in vars(table).values()))
    found = poses_at(none, deltas[0][:0], deltas[1][:0], 0.5, MAX_GAP, backend=backend)
    assert [len(values) for values in vars(found).values()] == [0, 0, 0]
    gradients = torch.autograd.grad(found.translations.sum(), deltas)
    assert not any(bool(gradient.any()) for gradient in gradients)


@every_fast_backend
def test_tables_of_another_kind_are_refused(backend):
    table, deltas = on_device(backend, torch.float32)
    with pytest.raises(ValueError, match=r"takes .*float32.* tensors.*use backend='torch'"):
        poses_at(in_double(table), *deltas, 0.5, MAX_GAP, backend=backend)
