"""A network that deforms each Gaussian of a node at a time (Deformable 3DGS, Yang et al. 2024)."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


@dataclass(frozen=True)
class NetworkSettings:
    """Sizes of a deformation network; the defaults are DriveStudio's. Raises ValueError for impossible sizes."""

    width: int = 256
    depth: int = 8
    """Number of hidden layers."""
    skip: int = 5
    """The inputs are added again after this layer; 0: nowhere."""
    position_octaves: int = 10
    """Number of octaves of sines and cosines that encode a position: wavelengths 2 pi, pi, pi / 2 ..."""
    time_octaves: int = 10
    scales: bool = True
    """Whether the network deforms scales too."""

    def __post_init__(self) -> None:
        if self.width < 1 or self.depth < 1 or min(self.position_octaves, self.time_octaves) < 0:
            raise ValueError(
                "a network needs width and depth of at least 1 and octaves of at least 0, got "
                f"{self.width}, {self.depth}, {self.position_octaves} and {self.time_octaves}"
            )
        if not 0 <= self.skip < self.depth:
            raise ValueError(
                f"skip={self.skip} must be a layer before the last of depth={self.depth}: take 0 for a network "
                "without skip"
            )


@dataclass(frozen=True)
class Deformation:
    """The values that are added to the rows."""

    means: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    """Added to quaternions of unit length."""
    log_scales: Float[Tensor, "n 3"] | None
    """None: the scales stay."""


class DeformationNetwork(nn.Module):
    """A network (position, time, features of the instance) -> Deformation for all rows at once, zero at the start.

    A layer that sees the inputs sums a part for the row and a part for the instant. Many rows share time and instance,
    so the latter part is computed once for each instance.

    >>> network = DeformationNetwork(NetworkSettings(width=8, depth=2, skip=1))
    >>> network(torch.rand(5, 3), time=0.5).means.abs().max().item()
    0.0
    """

    def __init__(self, settings: NetworkSettings, features: int = 0, seed: int = 0) -> None:
        """``features``: number of learned features of an instance; ``seed``: seed of the weights."""
        super().__init__()
        self.settings = settings
        width = settings.width
        # Draw weights from their own stream, so that other draws do not change them.
        with torch.random.fork_rng(devices=()):
            torch.default_generator.manual_seed(seed)
            self.first = _Inputs(settings, features)
            self.again = _Inputs(settings, features) if settings.skip else None
            self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(settings.depth - 1))
            self.last = nn.Linear(width, 10 if settings.scales else 7)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(
        self,
        positions: Float[Tensor, "n 3"],
        time: float,
        features: Float[Tensor, "i f"] | None = None,
        instances: Int[Tensor, " n"] | None = None,
    ) -> Deformation:
        """Takes ``features`` of the instances and the instance of each row, or neither."""
        rows = encoded(positions, self.settings.position_octaves)
        instants = encoded(positions.new_full((1, 1), time), self.settings.time_octaves)
        if features is not None:
            instants = torch.cat((instants.expand(len(features), -1), features), dim=1)
        values = torch.relu_(self.first(rows, instants, instances))
        for number, layer in enumerate(self.hidden, start=1):
            values = layer(values)
            if self.again is not None and number == self.settings.skip:
                values = values + self.again(rows, instants, instances)
            values = torch.relu_(values)
        means, quaternions, *scales = self.last(values).split((3, 4, 3)[: 3 if self.settings.scales else 2], dim=1)
        return Deformation(means, quaternions, scales[0] if scales else None)


def check_stored(settings: NetworkSettings, tensors: Mapping[str, Tensor], features: int = 0) -> None:
    """Raises ValueError unless a node's tensors in a scene file hold the network that its settings say.

    For whoever restores a node: settings decide how much memory a network takes, and a damaged file says anything.
    """
    stored = {name: value.shape for name, value in tensors.items() if name.startswith("network.")}
    if settings.depth <= len(stored):  # each layer has a tensor or two
        with torch.device("meta"):  # shapes alone
            made = DeformationNetwork(settings, features).state_dict()
        if stored == {f"network.{name}": value.shape for name, value in made.items()}:
            return
    raise ValueError(
        f"the file's {len(stored)} tensors of a network are not those of {settings} with {features} features: "
        "write the file again"
    )


class _Inputs(nn.Module):
    """The part of a layer that sees the inputs: one linear layer of all inputs, computed in two parts."""

    def __init__(self, settings: NetworkSettings, features: int) -> None:
        super().__init__()
        self.of_row = nn.Linear(3 * (1 + 2 * settings.position_octaves), settings.width)
        self.of_instant = nn.Linear(1 + 2 * settings.time_octaves + features, settings.width, bias=False)

    def forward(self, rows: Tensor, instants: Tensor, instances: Tensor | None) -> Tensor:
        if instances is None:
            # A single instant for all rows acts as a bias.
            bias = self.of_row.bias + self.of_instant(instants)[0]
            return nn.functional.linear(rows, self.of_row.weight, bias)
        return self.of_row(rows) + self.of_instant(instants).index_select(0, instances)


def encoded(values: Float[Tensor, "n c"], octaves: int) -> Float[Tensor, "n e"]:
    """Returns the values, and sines and cosines of 1, 2, 4 ... times them; each octave is computed from the last.

    >>> encoded(torch.zeros(1, 1), octaves=2).tolist()
    [[0.0, 0.0, 1.0, 0.0, 1.0]]
    """
    parts = [values]
    for octave in range(octaves):
        if octave == 0:
            parts += [torch.sin(values), torch.cos(values)]
        else:
            sine, cosine = parts[-2:]
            parts += [2 * sine * cosine, 1 - 2 * sine.square()]
    return torch.cat(parts, dim=1)
