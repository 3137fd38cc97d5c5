"""The network of deformations: its parts are one plain network, its encodings are sines, and it starts at zero."""

import math

import pytest
import torch
from torch import Tensor

from sparsestreet.scene.nodes.deformable import DeformationNetwork, NetworkSettings, encoded

SMALL = NetworkSettings(width=12, depth=4, skip=2, position_octaves=3, time_octaves=2)


def awake(network: DeformationNetwork) -> DeformationNetwork:
    """With weights in the last layer too."""
    with torch.no_grad():
        generator = torch.Generator().manual_seed(1)
        network.last.weight.copy_(torch.randn(network.last.weight.shape, generator=generator))
    return network


def plain(network: DeformationNetwork, positions: Tensor, time: float, features: Tensor) -> Tensor:
    """By concatenation of everything that is known of a row, in float64, with sines from math."""

    def sines(value: float, octaves: int) -> list[float]:
        return [f(2**octave * value) for octave in range(octaves) for f in (math.sin, math.cos)]

    settings, made = network.settings, []
    weights = {name: value.detach().double() for name, value in network.named_parameters()}
    for position, own in zip(positions.tolist(), features.tolist(), strict=True):
        octaves = [(f, 2**octave) for octave in range(settings.position_octaves) for f in (math.sin, math.cos)]
        row = [*position, *(f(times * c) for f, times in octaves for c in position)]
        inputs = torch.tensor([*row, time, *sines(time, settings.time_octaves), *own], dtype=torch.float64)
        first = torch.cat((weights["first.of_row.weight"], weights["first.of_instant.weight"]), dim=1)
        values = torch.relu(first @ inputs + weights["first.of_row.bias"])
        for number in range(1, settings.depth):
            weight, bias = weights[f"hidden.{number - 1}.weight"], weights[f"hidden.{number - 1}.bias"]
            if number == settings.skip:
                again = torch.cat((weights["again.of_row.weight"], weights["again.of_instant.weight"]), dim=1)
                weight, bias = torch.cat((weight, again), dim=1), bias + weights["again.of_row.bias"]
                values = torch.cat((values, inputs))
            values = torch.relu(weight @ values + bias)
        made.append(weights["last.weight"] @ values + weights["last.bias"])
    return torch.stack(made)


@pytest.mark.parametrize("skip", [0, 1, 2, 3])
def test_it_is_one_network_of_all_inputs(skip: int):
    settings = NetworkSettings(width=12, depth=4, skip=skip, position_octaves=3, time_octaves=2)
    network = awake(DeformationNetwork(settings, features=5, seed=3))
    generator = torch.Generator().manual_seed(2)
    positions, features = torch.rand(7, 3, generator=generator), torch.rand(2, 5, generator=generator)
    instances = torch.tensor([0, 1, 1, 0, 1, 0, 0])
    made = network(positions, 0.6, features, instances)
    expected = plain(network, positions, 0.6, features[instances])
    joined = torch.cat((made.means, made.quaternions, made.log_scales), dim=1).double()
    torch.testing.assert_close(joined, expected, rtol=1e-5, atol=1e-5)


def test_without_instances_time_is_the_same_for_all():
    network = awake(DeformationNetwork(SMALL, seed=3))
    positions = torch.rand(7, 3, generator=torch.Generator().manual_seed(2))
    made, expected = network(positions, 0.6), plain(network, positions, 0.6, torch.zeros(7, 0))
    joined = torch.cat((made.means, made.quaternions, made.log_scales), dim=1).double()
    torch.testing.assert_close(joined, expected, rtol=1e-5, atol=1e-5)


def test_octaves_are_sines_of_their_multiples():
    """Each doubling doubles the rounding of the one before: after nine of them 2^9 of 1e-7, and some."""
    values = torch.linspace(-2, 2, 101)[:, None]
    made = encoded(values, 10)
    assert torch.equal(made[:, :1], values)
    for octave in range(10):
        exact = torch.cat((torch.sin(2**octave * values.double()), torch.cos(2**octave * values.double())), dim=1)
        bound = 2e-7 * 2.5**octave
        torch.testing.assert_close(made[:, 1 + 2 * octave : 3 + 2 * octave].double(), exact, rtol=0, atol=bound)
    assert torch.equal(encoded(values, 0), values)


def test_it_starts_at_zero_and_learns_from_the_last_layer():
    network = DeformationNetwork(SMALL)
    made = network(torch.rand(5, 3), 0.2)
    for change in (made.means, made.quaternions, made.log_scales):
        assert not change.any()
    (made.means.sum() + made.quaternions.sum() + made.log_scales.sum()).backward()
    assert network.last.weight.grad.any()


def test_weights_are_those_of_the_seed_and_leave_other_draws_alone():
    torch.manual_seed(5)
    following = torch.rand(3)
    torch.manual_seed(5)
    first, same, other = (DeformationNetwork(SMALL, seed=seed).first.of_row.weight for seed in (1, 1, 2))
    assert torch.equal(torch.rand(3), following)
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"width": 0}, "width and depth of at least 1"),
        ({"time_octaves": -1}, "octaves of at least 0"),
        ({"depth": 3, "skip": 3}, "skip=3 must be a layer before the last of depth=3"),
        ({"skip": -1}, "skip=-1"),
    ],
)
def test_sizes_that_cannot_be(changes: dict, said: str):
    with pytest.raises(ValueError, match=said):
        NetworkSettings(**changes)
