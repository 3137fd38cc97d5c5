"""A whole street that one network deforms over time (Deformable 3DGS, Yang et al. 2024). Moving objects need no box."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.geometry.cameras import distance_to_view
from sparsestreet.geometry.quaternions import normalized
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.masks import Mask
from sparsestreet.scene.nodes.background import BackgroundSettings
from sparsestreet.scene.nodes.network import DeformationNetwork, NetworkSettings, check_stored
from sparsestreet.scene.nodes.node import BYTES_PER_NUMBER, Node, stored_frame_periods
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View

_MARGIN = 0.25
"""Fraction of the image size that lenses and shutters may show beyond the image of a pinhole."""


@dataclass(frozen=True, kw_only=True)
class FieldSettings(BackgroundSettings):
    """Settings of a field that starts from the points of a background.

    Raises ValueError for an impossible reach.
    """

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
        """Raises ValueError if there is not a single point to start from."""
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
        """Returns all rows; those in or near the view are deformed."""
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
        """Returns rows that the view may see once deformed; a row ends three standard deviations from its center."""
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
        """Returns noise that depends on the step alone, so a resumed run draws the same as an uninterrupted one."""
        settings = self.settings
        left = max(1 - state.progress / settings.time_noise_until, 0.0) if settings.time_noise_until > 0 else 0.0
        normal = torch.randn((), generator=named_generator(self.seed, f"time noise {state.progress}")).item()
        return normal * left * settings.time_noise / self.frame_periods
