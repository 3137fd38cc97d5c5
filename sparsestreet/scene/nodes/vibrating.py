"""A whole street of Gaussians that swing and fade (PVG, Chen et al. 2023). Moving objects need no box."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.density.vibrating import displacements, faded_logits, mean_velocities
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.masks import Mask
from sparsestreet.scene.nodes.background import BackgroundSettings
from sparsestreet.scene.nodes.node import Node, stored_frame_periods
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View


@dataclass(frozen=True, kw_only=True)
class VibratingSettings(BackgroundSettings):
    """Settings of a node that starts from the points of a background, at rest.

    A lidar return peaks at the time of its sweep, any other point where ``random_life_peaks`` says. Raises ValueError
    for impossible times or probabilities.
    """

    limit_rises: bool = False
    frame_time: float = 0.02
    """The node's time from one frame to the next; cycle and life spans are in the node's time."""
    cycle: float = 0.2
    """Period of a swing."""
    initial_life_span: float = math.sqrt(0.1)
    """Initial standard deviation of the opacity over time."""
    random_life_peaks: bool = True
    """Whether points without a time of measurement peak at random times; False: at the first frame (DriveStudio)."""
    min_factor: float = 0.05
    """A row whose opacity has faded to this fraction of its peak or below is not drawn."""
    velocity_weight: float = 0.001
    """Weight of the regularizer, which is the mean length of the mean velocities."""
    smoothing_probability: float = 0.5
    """Probability that a training step takes rows from a nearby time and moves them back by their mean velocity."""
    smoothing_frames: float = 1.5
    """Largest distance of that time, in frames."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("frame_time", "cycle", "initial_life_span"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is a time and must be above 0, got {getattr(self, name)}")
        if not 0 < self.min_factor < 1:
            raise ValueError(f"min_factor must lie between 0 and 1, got {self.min_factor}: PVG has 0.05")
        if not 0 <= self.smoothing_probability <= 1:
            raise ValueError(f"smoothing_probability must lie in [0, 1], got {self.smoothing_probability}")

    def build(self, data: TrainingData, generator: torch.Generator) -> "Vibrating":
        """Raise ValueError if there is not a single point to start from."""
        seed = generator.initial_seed()
        periods = data.log.frame_periods if data.log.num_frames > 1 else 0.0
        seeds = self.seeds(data, generator)
        anywhere = torch.zeros(len(seeds))
        if self.random_life_peaks:
            anywhere = torch.rand(len(seeds), generator=named_generator(seed, "life peaks"))
        peaks = torch.where(seeds.times.isnan(), anywhere, seeds.times) * self.frame_time * periods
        columns = {
            "velocities": torch.zeros(len(seeds), 3),
            "life_peaks": peaks,
            "log_life_spans": torch.full((len(seeds),), math.log(self.initial_life_span)),
        }
        rows, mask = self.start_from(seeds, data, generator, columns)
        return Vibrating(self, rows, frame_periods=periods, seed=seed, mask=mask)

    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Vibrating":
        return Vibrating(self, rows, frame_periods=stored_frame_periods(header), seed=header["seed"])


class Vibrating(Node):
    """Rows in the world frame with three more columns: ``velocities`` [n, 3], ``life_peaks`` [n] and ``log_life_spans``
    [n]. Velocities are those at the life peak, meters per unit of the node's time."""

    settings: VibratingSettings

    def __init__(
        self, settings: VibratingSettings, rows: Rows, *, frame_periods: float, seed: int = 0, mask: Mask | None = None
    ) -> None:
        """``frame_periods``: of the log; ``seed``: seed of the temporal smoothing."""
        super().__init__(settings, rows, mask)
        self.frame_periods = frame_periods
        self.seed = seed

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """Return every row at its place and with its opacity at the view's time; faded rows are hidden."""
        rows, settings, stored = self.rows, self.settings, self.stored(view)
        shift = self._shift(state) if state.training else 0.0
        ages = view.time * settings.frame_time * self.frame_periods + shift - rows.life_peaks
        means = rows.means + displacements(rows.velocities, ages, settings.cycle)
        if shift:
            means = means - shift * self.mean_velocities()
        deviations = ages * torch.exp(-rows.log_life_spans)
        seen = (deviations.detach().abs() < math.sqrt(-2 * math.log(settings.min_factor))).to(means.dtype)
        return replace(
            stored,
            means=means,
            opacity_logits=faded_logits(rows.opacity_logits, -0.5 * deviations.square()),
            multipliers=seen if stored.multipliers is None else stored.multipliers * seen,
        )

    def mean_velocities(self) -> Float[Tensor, "n 3"]:
        """Return the average velocity of each row, meters per unit of the node's time."""
        return mean_velocities(self.rows.velocities, self.rows.log_life_spans, self.settings.cycle)

    def own_regularizers(
        self, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        """Return ``velocity``, which keeps rows still that need not move."""
        lengths = self.mean_velocities().norm(dim=1) * drawn
        return {"velocity": self.settings.velocity_weight * lengths.sum() / drawn.sum().clamp(min=1)}

    def header(self) -> dict[str, Any]:
        return {"frame_periods": self.frame_periods, "seed": self.seed}

    def _shift(self, state: SceneState) -> float:
        """Return the difference from the view's time to the time that rows are taken from.

        It depends on the step alone, so a resumed run draws the same as an uninterrupted one.
        """
        settings = self.settings
        chance, place = torch.rand(2, generator=named_generator(self.seed, f"smoothing {state.progress}")).tolist()
        if chance >= settings.smoothing_probability:
            return 0.0
        return (2 * place - 1) * settings.smoothing_frames * settings.frame_time
