"""What views have shown of rows: the areas of instances, and how far images change without each row."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.lazy import Frames
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.scene.gaussians import InstanceFloors, RowPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Instances, Node
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


class Floors(NamedTuple):
    """The least numbers of rows of a node and its instances, as ``keep_best`` takes them.

    >>> Floors(min_gaussians=100)
    Floors(min_gaussians=100, instances=None)
    """

    min_gaussians: int
    instances: InstanceFloors | None = None


class InstanceAreas:
    """Accumulates, view by view, the largest area that each instance of some nodes fills, and returns their floors.

    The area is the sum of the blend weights of the instance's rows over the pixels: the visible area in pixels. An
    object that is hidden, far or transparent in all views fills little and keeps little. One that fills anything keeps
    at least one row.
    """

    def __init__(self, nodes: Mapping[str, Node]) -> None:
        self._nodes = dict(nodes)
        objects = {name: node.instances() for name, node in nodes.items() if node.settings.min_instance_gaussians > 0}
        self._pixels: dict[str, Tensor] = {
            name: torch.zeros(len(instances.names), dtype=torch.float64, device=instances.ids.device)
            for name, instances in objects.items()
            if instances is not None
        }

    @property
    def needed(self) -> bool:
        """Whether any instance has a floor of its own."""
        return bool(self._pixels)

    def add(self, weight: Float64[Tensor, " n"], spans: Mapping[str, slice]) -> None:
        """Add one view of the whole scene: the blend weights of all rows, summed over its pixels.

        ``spans``: name of a node -> its rows."""
        for name, largest in self._pixels.items():
            ids = self._instances(name).ids
            filled = torch.zeros_like(largest).index_add(0, ids, weight[spans[name]].to(largest))
            self._pixels[name] = torch.maximum(largest, filled)

    def clear(self) -> None:
        """Forget all views."""
        self._pixels = {name: torch.zeros_like(pixels) for name, pixels in self._pixels.items()}

    def state_dict(self, ranks: Ranks) -> dict[str, Tensor]:
        """Return the areas that the views of all ``ranks`` show."""
        return {name: ranks.largest(pixels.clone()) for name, pixels in self._pixels.items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self._pixels = {name: state[name].to(pixels) for name, pixels in self._pixels.items()}

    def floors(self, ranks: Ranks = ALONE) -> dict[str, Floors]:
        """Return name of every node -> its floors, from the views of all ``ranks``.

        Raises ValueError for an area that is not finite.
        """
        self._pixels = self.state_dict(ranks)
        return {
            name: Floors(node.settings.min_gaussians, self._of_instances(name)) for name, node in self._nodes.items()
        }

    def _of_instances(self, name: str) -> InstanceFloors | None:
        pixels = self._pixels.get(name)
        if pixels is None:
            return None
        instances = self._instances(name)
        if not pixels.isfinite().all():
            index = int((~pixels.isfinite()).nonzero()[0])
            raise ValueError(
                f"an instance fills a finite number of pixels, but {instances.names[index]!r} of node {name!r} fills "
                f"{float(pixels[index])}: look for NaN in its Gaussians before pruning"
            )
        least = (self._nodes[name].settings.min_instance_gaussians * pixels / 1000).ceil().long()
        return InstanceFloors(instances.ids, torch.minimum(least, instances.counts()))

    def _instances(self, name: str) -> Instances:
        """As they are now: rows may go between two views."""
        instances = self._nodes[name].instances()
        assert instances is not None  # it had some when areas were begun
        return instances


REGIONS = 3
"""Whose squared errors and changes are told apart: the whole image, vehicles, people."""


def regions(frame: Frame) -> Float[Tensor, "3 h w"]:
    """Return 1 where a pixel belongs to the whole image, to vehicles, to people; to none where it is of the recording
    car, which training does not show to the scene."""
    everywhere = torch.ones(frame.image.shape[:2], dtype=torch.bool, device=frame.image.device)
    everywhere = everywhere if frame.ego is None else ~frame.ego
    nowhere = torch.zeros_like(everywhere)
    marked = [nowhere if mask is None else mask & everywhere for mask in (frame.vehicle, frame.human)]
    return torch.stack([everywhere, *marked]).float()


def squared_errors(rgb: Float[Tensor, "h w 3"], frame: Frame) -> Float64[Tensor, "3"]:
    """Return the squared error of an image of one frame, summed over pixels and channels, for each of its regions."""
    squared = (rgb.clamp(0, 1) - frame.image.to(rgb) / 255).square().sum(-1).double()
    return regions(frame).double().flatten(1) @ squared.flatten()


class Gathered:
    """What training steps have found out for a pass of ``LeaveOneOutRule``: sums over the views that they showed.

    An ordinary step has rendered its view anyway, and its backward pass says how far the view changes without each row
    (``ops.LeaveOneOutSums``). That is of the scene as it was at that step. The regions are summed apart, because what a
    change weighs, 1 / squared error, is known only when all views were seen: so errors and changes are of the same
    images, and nothing has to be gathered before them.
    """

    def __init__(self, scene: SceneGraph, areas: InstanceAreas) -> None:
        """``areas``: of the instances whose floors the rule respects."""
        self.areas = areas
        self.views: set[tuple[int, int]] = set()
        """Frame and camera index of what was seen."""
        self.errors = torch.zeros(REGIONS, dtype=torch.float64, device=scene.device)
        self.counts = scene.counts()
        rows = sum(self.counts.values())
        self.largest: Float64[Tensor, " n"] = self.errors.new_zeros(rows)
        """Largest change of any pixel, of the rows of all nodes in their order."""
        self.squared: Float64[Tensor, "n r"] = self.errors.new_zeros(rows, REGIONS)
        """Squared change in each region."""

    @torch.no_grad()
    def add(self, frame: Frame, rendering: SceneRendering) -> None:
        """Add a view after its backward pass. One that gathered nothing is not added, nor one that was seen before."""
        sums, effects = rendering.changes or (None, None)
        if effects is None or sums is None or sums.found is None or frame.indices in self.views:
            return
        found = sums.found
        self.views.add(frame.indices)
        self.errors += squared_errors(rendering.rgb, frame)
        torch.maximum(self.largest, effects.most(found.max_abs_change), out=self.largest)
        self.squared += found.squared_change
        self.areas.add(found.weight, rendering.spans)

    def resize(self, name: str, plan: RowPlan) -> None:
        """Follow the rows of a node. Where rows came or were moved, nothing is left: it was about another scene."""
        if plan.edits or plan.reset_moments or bool(plan.fresh.any()):
            self.views.clear()
            self.errors.zero_()
            self.areas.clear()
            self.largest.zero_()
            self.squared.zero_()
        self.largest, self.squared = (self._resized(rows, name, plan) for rows in (self.largest, self.squared))
        self.counts[name] = len(plan.source)

    def rest(self, frames: Frames, ranks: Ranks = ALONE) -> Frames:
        """Return the frames that no process has seen."""
        seen = set().union(*ranks.gathered(self.views))
        return frames.where(lambda view: view.indices not in seen)

    def state_dict(self, ranks: Ranks = ALONE) -> dict[str, Any]:
        """Return what all processes have seen together, for one of them to go on with."""
        return {
            "views": set().union(*ranks.gathered(self.views)),
            "errors": ranks.sum(self.errors.clone()),
            "largest": ranks.largest(self.largest.clone()),
            "squared": ranks.sum(self.squared.clone()),
            "areas": self.areas.state_dict(ranks),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.views = set(state["views"])
        self.errors, self.largest, self.squared = (
            state[name].to(self.errors.device) for name in ("errors", "largest", "squared")
        )
        self.areas.load_state_dict(state["areas"])

    def _resized(self, rows: Tensor, name: str, plan: RowPlan) -> Tensor:
        parts = dict(zip(self.counts, rows.split(list(self.counts.values())), strict=True))
        return torch.cat(list((parts | {name: parts[name][plan.source]}).values()))
