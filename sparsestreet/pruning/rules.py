"""What decides which rows of some nodes go, given all training views: by the paper's importance or by removal."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.ops import leave_one_out
from sparsestreet.pruning.importance import Importance
from sparsestreet.pruning.rule import PruningRule, RenderContext, contributions, on_device
from sparsestreet.pruning.select import keep_by_cost, keep_by_importance, keep_by_rank
from sparsestreet.scene.effects import linearized
from sparsestreet.scene.gaussians import Selection
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import render
from sparsestreet.types import Frame, LeaveOneOut

LEAST_ERROR = 1e-12
"""Squared error (images lie in [0, 1]) that stands for none; its inverse fits into float32."""


@dataclass(frozen=True)
class ImportanceRule(PruningRule):
    """The paper's: rows whose global importance is zero go (see ``Importance``).

    The whole scene is rendered for the scores: cars hide the road behind them.
    """

    gate: bool = True
    """Count a view only for rows that are the largest contributor of one of its pixels."""
    remove: int | float | None = None
    """For comparisons at equal count: so many rows go instead, the least important of all nodes together that the rule
    may take from; up to 1 a fraction of the rows of the whole scene, above 1 their number."""

    def __post_init__(self) -> None:
        if self.remove is not None and not self.remove >= 0:
            raise ValueError(f"remove must be a fraction in [0, 1] or a number of Gaussians, got {self.remove}")

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        importance, areas = Importance(self.gate), self.areas(scene)
        for view, spans in contributions(scene, frames, context):
            importance.add(view)
            areas.add(view, spans)
        every, floors = importance.scores(), areas.floors()
        scores = {name: every[spans[name]] for name in floors}
        if self.remove is None:
            return {name: keep_by_importance(scores[name], floors[name]) for name in floors}
        return keep_by_rank(scores, round(self.remove * len(every) if self.remove <= 1 else self.remove), floors)


@dataclass(frozen=True)
class LeaveOneOutRule(PruningRule):
    """Rows go that the training images miss least, as many as cost ``allowed_db`` of their PSNR.

    The cost of a row is the sum over views, pixels and channels of the squared change when it alone is taken away,
    relative to the present squared error: of the whole images, plus the same of the pixels that show vehicles and of
    those that show people, where the log marks them. These are few, and a loss there would drown in the whole. The row
    of least cost goes first, as long as the sum stays below the 10^(dB / 10) - 1 that ``allowed_db`` stands for: so
    neither the images nor their vehicles nor their people pay more. That takes changes as independent of each other and
    of the error; what overlapping rows lose together is more, and is made up for by the steps that follow. Unlike
    the importance gate this asks whether a row would be missed, not whether it leads somewhere.

    Images are those behind the scene's effects, which change them by their slopes (``effects.linearized``).

    A row that moves no channel of any pixel by more than ``noticeable`` costs nothing.
    """

    allowed_db: float
    """Decibels a pass may cost before the scene is trained on, >= 0; 0: only rows that nobody sees go."""
    noticeable: float = 1 / 255
    """One step of an 8-bit image; 0: every change counts."""

    def __post_init__(self) -> None:
        if not self.allowed_db >= 0:
            raise ValueError(f"allowed_db must be >= 0 dB of training PSNR, got {self.allowed_db}")
        if not self.noticeable >= 0:
            raise ValueError(f"noticeable must be >= 0 (images lie in [0, 1]), got {self.noticeable}")

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        costs, floors = self.costs(scene, frames, context), self.floors(scene, frames, context)
        return keep_by_cost({name: costs[name] for name in floors}, 10 ** (self.allowed_db / 10) - 1, floors)

    @torch.no_grad()
    def costs(
        self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext
    ) -> dict[str, Float64[Tensor, " _"]]:
        """Name of a node -> what each of its rows costs, relative to the present squared error."""
        errors = sum(_squared_errors(scene, frame, context) for frame in on_device(scene, frames))
        spans = scene.gaussians_at(frames[0], context.state).spans
        rows = max(span.stop for span in spans.values())
        largest, squared = torch.zeros(2, rows, dtype=torch.float64, device=errors.device)
        for frame in on_device(scene, frames):
            change = _without_each(scene, frame, errors, context)
            largest, squared = torch.maximum(largest, change.max_abs_change), squared + change.squared_change
        costs = torch.where(largest > self.noticeable, squared, 0.0)
        return {name: costs[rows] for name, rows in spans.items()}


def _regions(frame: Frame) -> Float[Tensor, "3 h w"]:
    """1 where a pixel belongs to the whole image, to vehicles, to people."""
    everywhere = torch.ones(frame.image.shape[:2], dtype=torch.bool, device=frame.image.device)
    nowhere = torch.zeros_like(everywhere)
    marked = [nowhere if mask is None else mask for mask in (frame.vehicle, frame.human)]
    return torch.stack([everywhere, *marked]).float()


def _without_each(scene: SceneGraph, frame: Frame, errors: Float64[Tensor, "3"], context: RenderContext) -> LeaveOneOut:
    """Behind the effects; squared changes are relative to the error of the regions that a pixel belongs to.

    The largest change is multiplied by the largest slope of any pixel: at least as much as is seen of it.
    """
    # Where no error is left, any change costs too much. A region that no frame marks has no pixel to weigh.
    share = 1 / errors.clamp(min=LEAST_ERROR)
    weights = torch.einsum("r,rhw->hw", share.float(), _regions(frame))
    placed = scene.gaussians_at(frame, context.state)
    effects = linearized(scene.effects.values(), placed.view)
    change = leave_one_out(
        placed.gaussians,
        placed.view.camera,
        background=effects.background,
        pixel_weights=weights if effects.slope is None else weights * effects.slope.square(),
        settings=context.options.settings,
        backend=context.options.backend,
    )
    if effects.slope is None:
        return change
    return replace(change, max_abs_change=effects.slope.max() * change.max_abs_change)


def _squared_errors(scene: SceneGraph, frame: Frame, context: RenderContext) -> Float64[Tensor, "3"]:
    """Sum over pixels and channels of the squared error of one frame, in each of its regions."""
    image = render(scene, frame, context.state, context.options).rgb
    squared = (image.clamp(0, 1) - frame.image.to(image) / 255).double().square().sum(-1)
    return (_regions(frame).double() * squared).sum((1, 2))
