"""Nodes whose Gaussians a network moves over time: deformable objects, and a deformable field (DeformGS)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from sparsestreet.geometry.cameras import distance_to_view
from sparsestreet.geometry.quaternions import normalized
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.masks import Mask
from sparsestreet.scene.nodes.background import BackgroundSettings
from sparsestreet.scene.nodes.node import BYTES_PER_NUMBER, Node, stored_frame_periods
from sparsestreet.scene.nodes.tracked import Tracked, TrackedSettings
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View


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
        """Take ``features`` of the instances and the instance of each row, or neither."""
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
    """Raise ValueError unless a node's tensors in a scene file hold the network that its settings say.

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
    """Return the values, and sines and cosines of 1, 2, 4 ... times them; each octave is computed from the last.

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


@dataclass(frozen=True, kw_only=True)
class DeformableSettings(TrackedSettings):
    """``TrackedSettings`` with options of the deformation."""

    network: NetworkSettings = field(default_factory=lambda: NetworkSettings(scales=False))
    features: int = 16
    """Number of learned features of each instance, for the network that all instances share."""
    deform_from: float = 0.1
    """Fraction of the run from which rows are deformed; before, the rows take shape without a network."""
    detach_means: bool = True
    """Whether rows then keep their place in the box and only the network moves them, as in DriveStudio."""
    refine_boxes: bool = True
    """Whether the annotated poses are corrected. DriveStudio intends to, but does not."""
    outside_weight: float = 1.0
    """Weight of the regularizer: mean distance, meters, by which coordinates of deformed rows lie outside their box."""

    @property
    def node_class(self) -> "type[Deformable]":
        return Deformable

    def build(self, data: TrainingData, generator: torch.Generator) -> "Deformable | None":
        """Build the node without boxes of frames that have no training image (held out, or outside the range)."""
        node = cast(Deformable | None, super().build(data, generator))  # it builds a node_class
        if node is not None:
            node.start_network(generator.initial_seed())
        return node

    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> Tracked:
        found, wanted = tuple(tensors["embeddings"].shape), (len(header["names"]), self.features)
        if found != wanted:
            raise ValueError(f"embeddings have shape {found}, names and settings say {wanted}: write the file again")
        check_stored(self.network, tensors, self.features)
        return super().restore(rows, tensors, header)


class Deformable(Tracked):
    """Rows in their boxes that one network deforms by place, time and the ``embeddings`` [i, f] of their instance."""

    settings: DeformableSettings

    def __init__(self, *args: Any, **keywords: Any) -> None:
        """Take the arguments of ``Tracked``; the network starts from seed 0."""
        super().__init__(*args, **keywords)
        for corrections in (self.rotation_deltas, self.translation_deltas):
            corrections.requires_grad_(self.settings.refine_boxes)
        self.start_network(0)

    def start_network(self, seed: int) -> None:
        """Draw weights, and embeddings uniform in [0, 1), from the seed's own stream."""
        features, generator = self.settings.features, torch.Generator().manual_seed(seed)
        self.embeddings = nn.Parameter(torch.rand(len(self.names), features, generator=generator).to(self.sizes))
        self.network = DeformationNetwork(self.settings.network, features, seed).to(self.sizes)

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """Return every instance's Gaussians, deformed and at its pose; opacity is exactly 0 if it is absent."""
        placed = self.placed(view)
        if state.progress < self.settings.deform_from:
            return placed
        means, instances = self.rows.means.detach(), self.rows.instances
        heights = self.sizes[:, 2:].index_select(0, instances)
        change = self.network(2 * means / heights, view.time, self.embeddings, instances)
        scales = placed.log_scales if change.log_scales is None else placed.log_scales + change.log_scales
        return replace(
            placed,
            means=(means if self.settings.detach_means else placed.means) + change.means,
            quaternions=normalized(placed.quaternions) + change.quaternions,
            log_scales=scales,
        )

    def own_regularizers(
        self, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        """Return ``out_of_box``, which replaces a cull because arms and legs may leave a box for a moment."""
        beyond = torch.relu(raw.means.abs() - self.sizes.index_select(0, self.rows.instances) / 2)
        return {"out_of_box": self.settings.outside_weight * beyond.sum() / max(beyond.numel(), 1)}

    def pose_bytes(self) -> int:
        """float32 bytes of keyframes, network and embeddings."""
        learned = sum(parameter.numel() for parameter in (self.embeddings, *self.network.parameters()))
        return super().pose_bytes() + BYTES_PER_NUMBER * learned


_MARGIN = 0.25
"""Fraction of the image size that lenses and shutters may show beyond the image of a pinhole."""


@dataclass(frozen=True, kw_only=True)
class FieldSettings(BackgroundSettings):
    """Settings of a field that starts from the points of a background.

    Raises ValueError for an impossible reach.
    """

    limit_rises: bool = False
    network: NetworkSettings = field(default_factory=NetworkSettings)
    deform_from: float = 0.1
    """Fraction of the run from which rows are deformed; before, the rows take shape without a network."""
    time_noise: float = 0.1
    """Standard deviation, in frames, of noise on the time that the network sees in training; falls linearly to 0."""
    time_noise_until: float = 0.667
    """Fraction of the run at which the noise reaches 0."""
    reach: float | None = 5.0
    """Meters. A row that the view could not see even this much nearer stays undeformed, because the network is most of
    the cost. None: all rows are deformed, and no GPU waits for their number."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reach is not None and self.reach < 0:
            raise ValueError(f"reach is a distance in meters and must be >= 0, got {self.reach}; null: no limit")

    def build(self, data: TrainingData, generator: torch.Generator) -> "Field":
        """Raise ValueError if there is not a single point to start from."""
        rows, mask = self.start_from(self.seeds(data, generator), data, generator)
        log = data.log
        return Field(
            self,
            rows,
            box_from_world=log.box_from_world,
            frame_periods=log.frame_periods,
            seed=generator.initial_seed(),
            mask=mask,
        )

    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Field":
        check_stored(self.network, tensors)
        if "box_from_world" not in tensors:
            raise ValueError(
                "the scene's network was trained in a ball, as until version 0.2.0, and positions are now those of the "
                "scene's box: train it again"
            )
        periods = stored_frame_periods(header)
        box = tensors["box_from_world"]
        return Field(self, rows, box_from_world=box, frame_periods=periods, seed=header["seed"])


class Field(Node):
    """Canonical rows in the world frame, and the network that moves, turns and scales them."""

    settings: FieldSettings
    box_from_world: Tensor

    def __init__(
        self,
        settings: FieldSettings,
        rows: Rows,
        *,
        box_from_world: Float[Tensor, "3 4"],
        frame_periods: float,
        seed: int = 0,
        mask: Mask | None = None,
    ) -> None:
        """``box_from_world`` maps the box of the scene, in which the network's positions are linear, to [-1, 1];
        ``frame_periods`` are the log's, ``seed`` is the seed of weights and noise."""
        super().__init__(settings, rows, mask)
        self.frame_periods = frame_periods
        self.seed = seed
        self.register_buffer("box_from_world", box_from_world)
        self.network = DeformationNetwork(settings.network, seed=seed)

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """Return all rows; those in or near the view are deformed."""
        stored = self.stored(view)
        if state.progress < self.settings.deform_from:
            return stored
        near = self._near(view)
        positions = self.rows.means.detach()
        time = view.time + (self._time_noise(state) if state.training else 0.0)
        change = self.network(self._contracted(positions if near is None else positions[near]), time)

        def changed(values: Tensor, by: Tensor) -> Tensor:
            return values + by if near is None else values.index_add(0, near, by)

        return replace(
            stored,
            means=changed(stored.means, change.means),
            quaternions=changed(normalized(stored.quaternions), change.quaternions),
            log_scales=stored.log_scales
            if change.log_scales is None
            else changed(stored.log_scales, change.log_scales),
        )

    def header(self) -> dict[str, Any]:
        return {"frame_periods": self.frame_periods, "seed": self.seed}

    def pose_bytes(self) -> int:
        """float32 bytes of the network."""
        return BYTES_PER_NUMBER * sum(parameter.numel() for parameter in self.network.parameters())

    @torch.no_grad()
    def _near(self, view: View) -> Int[Tensor, " k"] | None:
        """Return rows that the view may see once deformed; a row ends three standard deviations from its center."""
        if self.settings.reach is None:
            return None
        sizes = 3 * self.rows.log_scales.amax(1).exp()
        distances = distance_to_view(view.camera, self.rows.means, _MARGIN)
        return torch.nonzero(distances < sizes + self.settings.reach).squeeze(1)

    def _contracted(self, positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Maps the scene's box into [0.25, 0.75], each side by its own length, and everything beyond into [0, 1].

        As DriveStudio's DeformGS does: a street is long and low, and its height keeps its detail (docs/baselines.md).
        """
        scaled = positions @ self.box_from_world[:, :3].T + self.box_from_world[:, 3]
        lengths = scaled.norm(dim=1, keepdim=True).clamp(min=1.0)
        return scaled * (2 - 1 / lengths) / lengths / 4 + 0.5

    def _time_noise(self, state: SceneState) -> float:
        """Return noise that depends on the step alone, so a resumed run draws the same as an uninterrupted one."""
        settings = self.settings
        left = max(1 - state.progress / settings.time_noise_until, 0.0) if settings.time_noise_until > 0 else 0.0
        normal = torch.randn((), generator=named_generator(self.seed, f"time noise {state.progress}")).item()
        return normal * left * settings.time_noise / self.frame_periods
