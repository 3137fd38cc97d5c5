"""Poses by Triton and the gradients of their corrections, against torch in float64."""

import pytest
import torch

from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.ops.poses import poses_at
from sparsestreet.ops.triton import poses as fused
from tests.ops.scenes import device_of, fill_buffers_with_nan
from tests.ops.test_poses import MAX_GAP, Deltas, in_double, tables, values_and_gradients

DEVICE = device_of("triton")


def on_device(size: float) -> tuple[Trajectories, Deltas]:
    table, deltas = tables(torch.float32, size=size)
    turned, shifted = (delta.detach().to(DEVICE, copy=True).requires_grad_() for delta in deltas)
    return Trajectories(*(value.to(DEVICE) for value in vars(table).values())), (turned, shifted)


def assert_matches_float64(time: float, size: float) -> None:
    table, deltas = on_device(size)
    turned, shifted = (delta.detach().cpu().double().requires_grad_() for delta in deltas)
    doubles = turned, shifted

    def run(table: Trajectories, deltas: Deltas, time: float, backend: str):
        return tuple(vars(poses_at(table, *deltas, time, MAX_GAP, backend=backend)).values())

    found = values_and_gradients(deltas, lambda: run(table, deltas, time, "triton"))
    # The time itself is rounded as those of the table.
    rounded = float(torch.tensor(time))
    expected = values_and_gradients(doubles, lambda: run(in_double(table), doubles, rounded, "torch"))
    assert found[2].tolist() == expected[2].tolist()
    # Two units in the last place of numbers from 2 to 4: a pose at twice the way between two keyframes doubles the
    # rounding of both, and a device contracts what the interpreter rounds twice. Gradients are of size 1 to 3.
    for value, truth, bar in zip(found, expected, (5e-7, 1e-5, 0.0, 2e-6, 5e-7), strict=True):
        torch.testing.assert_close(value.cpu().double(), truth.double(), rtol=0.0, atol=bar)


@pytest.mark.parametrize("time", [0.05, 0.1, 0.17, 0.53, 0.9])
@pytest.mark.parametrize("size", [1e-4, 0.3, 3.0])
def test_it_says_what_torch_says(monkeypatch, time, size):
    """Turns near zero and beyond half a circle, times outside of spans and too far from any keyframe; many programs."""
    monkeypatch.setattr(fused, "LANES", 4)
    assert_matches_float64(time, size)


@pytest.mark.parametrize(("time", "present"), [(0.05, False), (0.6, True), (0.62, False)])
def test_padding_is_no_keyframe_and_equal_distances_may_differ_by_rounding(time, present):
    """One keyframe at 0.5; in float32 0.6 is farther from it than 0.1."""
    table, deltas = on_device(0.3)
    times, valid = torch.zeros_like(table.times), torch.zeros_like(table.valid)
    times[:, 0], valid[:, 0] = 0.5, True
    spans = torch.tensor([[0.0, 1.0]], device=DEVICE).expand(6, 2).contiguous()
    table = Trajectories(times, table.quaternions, table.translations, valid, spans)
    found = poses_at(table, *deltas, time, 0.1, backend="triton")
    assert found.present.tolist() == [present] * 6


def test_every_output_is_written(monkeypatch):
    fill_buffers_with_nan(monkeypatch)
    assert_matches_float64(0.26, 0.3)


def test_only_one_output_is_differentiated():
    table, deltas = on_device(0.3)
    for field, moved, resting in (("quaternions", 0, 1), ("translations", 1, 0)):
        poses = poses_at(table, *deltas, 0.26, MAX_GAP, backend="triton")
        gradients = torch.autograd.grad(getattr(poses, field).sum(), deltas)
        assert gradients[moved].any()
        assert not gradients[resting].any()


def test_no_instances():
    table, deltas = on_device(0.3)
    none = Trajectories(*(values[:0] for values in vars(table).values()))
    found = poses_at(none, deltas[0][:0], deltas[1][:0], 0.5, MAX_GAP, backend="triton")
    assert [len(values) for values in vars(found).values()] == [0, 0, 0]
    gradients = torch.autograd.grad(found.translations.sum(), deltas)
    assert not any(bool(gradient.any()) for gradient in gradients)


def test_tables_in_double_are_refused():
    table, deltas = on_device(0.3)
    with pytest.raises(ValueError, match=r"'triton' takes contiguous float32 tensors.*use backend='torch'"):
        poses_at(in_double(table), *deltas, 0.5, MAX_GAP, backend="triton")
