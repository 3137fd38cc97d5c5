"""Rules that select rows from all training views: the paper's importance, and our leave-one-out cost."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.lazy import as_frames
from sparsestreet.geometry.cameras import moved
from sparsestreet.ops import leave_one_out
from sparsestreet.pruning.importance import Importance
from sparsestreet.pruning.ranges import MIN_ERROR, depth_costs
from sparsestreet.pruning.seen import Gathered, regions, squared_errors
from sparsestreet.pruning.select import (
    Keep,
    PruningRule,
    RenderContext,
    check_keep,
    contributions,
    keep_by_cost,
    keep_by_importance,
    keep_by_rank,
    keep_counts,
    on_device,
)
from sparsestreet.scene.effects import linearized
from sparsestreet.scene.gaussians import Selection
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import render
from sparsestreet.types import Frame, LeaveOneOut, View


@dataclass(frozen=True)
class ImportanceRule(PruningRule):
    """The paper's rule: removes rows whose global importance is zero (see ``Importance``).

    The scores come from renders of the whole scene, because cars hide the road behind them.
    """

    gate: bool = True
    """Whether a view counts only for rows that are the largest contributor of one of its pixels."""
    remove: int | float | None = None
    """For comparisons at equal count: the rule removes this many rows instead, the least important of all its nodes
    together. A value up to 1 is a fraction of the rows of the whole scene; a larger one is a number of rows."""
    keep: Keep | None = None
    """For comparisons at equal count, node by node: the most important rows of each node stay (see ``select.Keep``)."""

    def __post_init__(self) -> None:
        if self.remove is not None and not self.remove >= 0:
            raise ValueError(f"remove must be a fraction in [0, 1] or a number of Gaussians, got {self.remove}")
        if self.keep is not None:
            check_keep(self.keep)
            if self.remove is not None:
                raise ValueError(f"a rule removes or keeps a number, got remove={self.remove} and keep={self.keep}")

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        importance, areas = Importance(self.gate), self.areas(scene)
        for view, spans in contributions(scene, frames, context):
            importance.add(view)
            areas.add(view.weight, spans)
        every, floors = importance.scores(context.ranks), areas.floors(context.ranks)
        scores = {name: every[spans[name]] for name in floors}
        if self.keep is not None:
            return keep_counts(scores, self.keep, floors, context)
        if self.remove is None:
            return {name: keep_by_importance(scores[name], floors[name]) for name in floors}
        return keep_by_rank(scores, round(self.remove * len(every) if self.remove <= 1 else self.remove), floors)


@dataclass(frozen=True)
class LeaveOneOutRule(PruningRule):
    """Removes the rows that change the training images least, until ``allowed_db`` of their PSNR is spent.

    The change of a row is the squared change of the images when this row alone is removed, summed over views, pixels
    and channels. Its cost is this change relative to the present squared error, for the whole images, plus the same for
    the pixels of vehicles and for those of people, where the log marks them. These regions are small, and a loss there
    would drown in the whole.

    Rows are removed from the least cost upwards while the sum of costs stays within 10^(dB / 10) - 1. So neither the
    images nor their vehicles nor their people lose more than ``allowed_db``. This treats changes as independent of each
    other and of the error. Overlapping rows lose more together; the training steps that follow make up for it. Unlike
    the importance gate, the cost asks whether a row would be missed, not whether it dominates a pixel.

    Images are compared after the scene's effects, whose slopes scale the changes (``effects.linearized``).

    A row that changes no channel of any pixel by more than ``noticeable`` costs nothing.

    What only a camera beside the path sees is not missed in any training image. With ``beside`` each training view
    counts once more from so far to one side, in turn right and left; its changes cost what they cost in the training
    images as a whole.
    """

    allowed_db: float
    """Decibels that a pass may cost before training continues, >= 0; 0: only rows that cost nothing are removed."""
    noticeable: float = 1 / 255
    """One step of an 8-bit image; 0: every change counts."""
    keep: Keep | None = None
    """For comparisons at equal count, node by node: the most expensive rows of each node stay instead, whatever that
    costs (see ``select.Keep``)."""
    beside: float | None = None
    """Meters; None: only recorded views count. Scoring takes twice the time."""
    depth: float = 0.1
    """Weight of the change of depth where lidar says that it is right, relative to its present error
    (``ranges.depth_changes``). It decides with the cost which rows go first; the budget is of images alone."""

    def __post_init__(self) -> None:
        if self.beside is not None and not self.beside > 0:
            raise ValueError(f"beside must be above 0 m, got {self.beside}: null asks the recorded views alone")
        if self.keep is not None:
            check_keep(self.keep)
        if not self.allowed_db >= 0:
            raise ValueError(f"allowed_db must be >= 0 dB of training PSNR, got {self.allowed_db}")
        if not self.depth >= 0:
            raise ValueError(f"depth is a weight >= 0 of the change of depth, got {self.depth}: 0 asks images alone")
        if not self.noticeable >= 0:
            raise ValueError(f"noticeable must be >= 0 (images lie in [0, 1]), got {self.noticeable}")

    @property
    def gathers(self) -> bool:
        """Whether training steps say all that is asked; none of them shows a view beside the path as it is recorded."""
        return self.beside is None

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        seen = context.gathered or Gathered(scene, self.areas(scene))
        costs = self.costs(scene, seen.rest(as_frames(frames), context.ranks), context, seen)
        floors = seen.areas.floors(context.ranks)
        costs = {name: costs[name] for name in floors}
        order = costs
        if self.depth > 0:
            of_depth = depth_costs(scene, frames, context)
            order = {name: cost + self.depth * of_depth[name] for name, cost in costs.items()}
        if self.keep is not None:
            return keep_counts(order, self.keep, floors, context)
        return keep_by_cost(costs, 10 ** (self.allowed_db / 10) - 1, floors, order)

    @torch.no_grad()
    def costs(
        self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext, seen: Gathered | None = None
    ) -> dict[str, Float64[Tensor, " _"]]:
        """Return name of a node -> the cost of each of its rows, relative to the present squared error.

        ``seen``: what training steps have gathered of other views than these; it gets the areas that these show.
        """
        ranks, seen = context.ranks, seen or Gathered(scene, self.areas(scene))
        errors = sum((_errors(scene, frame, context) for frame in on_device(scene, frames, ranks)), seen.errors)
        # If no error is left, any change costs too much. A region that no frame marks has no pixel to weigh.
        share = 1 / ranks.sum(errors.clone()).clamp(min=MIN_ERROR)
        largest, squared = seen.largest.clone(), seen.squared @ share
        for frame in on_device(scene, frames, ranks):
            for view, weights in self._seen(frame, share.float()):
                change, spans = _without_each(scene, view, weights, context)
                if view is frame:
                    seen.areas.add(change.weight, spans)
                largest, squared = torch.maximum(largest, change.max_abs_change), squared + change.squared_change
        largest, squared = ranks.largest(largest), ranks.sum(squared)
        costs = torch.where(largest > self.noticeable, squared, 0.0)
        return dict(zip(scene.nodes, costs.split(list(scene.counts().values())), strict=True))

    def _seen(self, frame: Frame, share: Float[Tensor, "3"]) -> Iterator[tuple[View, Float[Tensor, "h w"]]]:
        """Yield the view and, if asked, the one beside it, with the weight of a squared change of each pixel."""
        yield frame, torch.einsum("r,rhw->hw", share, regions(frame))
        if self.beside is not None:
            side = 1 if sum(frame.indices) % 2 else -1
            right = frame.camera.camera_from_world[0, :3].double()
            camera = moved(frame.camera, side * self.beside * right)
            yield replace(frame, camera=camera), share[0].expand(frame.image.shape[:2])


def _without_each(
    scene: SceneGraph, view: View, weights: Float[Tensor, "h w"], context: RenderContext
) -> tuple[LeaveOneOut, dict[str, slice]]:
    """Return the change without each row, after the effects, with weights of squared changes of the pixels.

    Also name of a node -> its rows.
    """
    placed = scene.gaussians_at(view, context.state)
    effects = linearized(scene.effects.values(), placed.view)
    change = leave_one_out(
        placed.gaussians,
        placed.view.camera,
        background=effects.background,
        pixel_weights=effects.weights(weights),
        settings=context.options.settings,
        backend=context.options.backend,
    )
    return replace(change, max_abs_change=effects.most(change.max_abs_change)), placed.spans


def _errors(scene: SceneGraph, frame: Frame, context: RenderContext) -> Float64[Tensor, "3"]:
    return squared_errors(render(scene, frame, context.state, context.options).rgb, frame)
