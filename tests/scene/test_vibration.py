"""How a vibrating Gaussian moves and fades, against a path that is integrated and logits in float64."""

import math

import numpy as np
import pytest
import torch

from sparsestreet.scene.density.vibrating import displacements, faded_logits, mean_velocities

CYCLE = 0.2


def test_it_moves_by_its_velocity_at_the_peak_and_swings_with_the_cycle():
    """x'' = -a^2 x from x(0) = 0, x'(0) = v, in steps of a thousandth of a cycle, is where it is at each age."""
    velocity, rate, step = torch.tensor([[3.0, -1.0, 0.5]]).double(), 2 * math.pi / CYCLE, CYCLE / 1000
    place, speed = torch.zeros(1, 3).double(), velocity + 0.0
    for index in range(1500):
        if index % 250 == 0:
            age = torch.tensor([index * step]).double()
            # The leapfrog's error is (a step)^2 / 24 of the swing of |v| / a = 0.1 m, times the swings.
            torch.testing.assert_close(displacements(velocity, age, CYCLE), place, rtol=0, atol=1e-5)
            torch.testing.assert_close(displacements(velocity, -age, CYCLE), -place, rtol=0, atol=1e-5)
        middle = place + 0.5 * step * speed
        speed = speed - step * rate**2 * middle
        place = middle + 0.5 * step * speed


def test_who_lives_long_goes_nowhere():
    velocities = torch.tensor([[2.0, 0.0, -4.0]] * 3)
    log_spans = torch.tensor([0.02, 0.2, 20.0]).log()  # staticness 0.1, 1, 100
    expected = velocities * torch.tensor([math.exp(-0.05), math.exp(-0.5), math.exp(-50)])[:, None]
    torch.testing.assert_close(mean_velocities(velocities, log_spans, CYCLE), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_faded_logit_gives_the_product(dtype: torch.dtype):
    """sigmoid(l) g, and what it lacks of 1, from numpy's longdouble: neither loses digits to the other."""
    logits = torch.tensor([-15.0, -4.0, 0.0, 3.0, 12.0, 15.0], dtype=dtype)[:, None]
    factors = torch.tensor([0.05, 0.3, 0.999, 1 - 1e-6, 1.0], dtype=dtype)
    made = faded_logits(logits.expand(6, 5).flatten(), factors.log().expand(6, 5).flatten()).double()
    opacity = 1 / (1 + np.exp(-logits.numpy().astype(np.longdouble)))
    lacking = 1 - opacity + opacity * (1 - factors.numpy().astype(np.longdouble))
    bound = 60 * torch.finfo(dtype).eps  # a logit is up to 18, and rounded once in each of three steps
    product = (opacity * factors.numpy()).ravel().astype(np.float64)
    np.testing.assert_allclose(torch.sigmoid(made).numpy(), product, rtol=bound, atol=0)
    # Torch's log1p of a double of 3e-7 is right to 2e-13.
    lacked = lacking.ravel().astype(np.float64)
    np.testing.assert_allclose(torch.sigmoid(-made).numpy(), lacked, rtol=max(bound, 1e-12), atol=0)


def test_gradients_of_a_faded_logit_are_finite_at_the_ends_and_those_of_finite_differences():
    logits = torch.tensor([-1e4, -15.0, 15.0, 1e4, 0.3], requires_grad=True)
    logs = torch.tensor([0.0, -3.0, -1e-7, 0.0, -0.5], requires_grad=True)
    faded_logits(logits, logs).sum().backward()
    assert logits.grad.isfinite().all()
    assert logs.grad.isfinite().all()
    inside = (torch.tensor([-9.0, -1.0, 0.5, 8.0]).double(), torch.tensor([-0.1, -2.9, -1e-3, -0.7]).double())
    assert torch.autograd.gradcheck(faded_logits, [value.requires_grad_() for value in inside])
