"""The rows that pruning must leave: K_min of a node, and a number for each instance that follows from its area."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.scene.gaussians import InstanceFloors
from sparsestreet.scene.nodes import Node
from sparsestreet.types import Contribution


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
        self._instances = {name: instances for name, instances in objects.items() if instances is not None}
        self._pixels: dict[str, Tensor] = {
            name: torch.zeros(len(each.names), dtype=torch.float64, device=each.ids.device)
            for name, each in self._instances.items()
        }

    @property
    def needed(self) -> bool:
        """Whether any instance has a floor of its own."""
        return bool(self._instances)

    def add(self, view: Contribution, spans: Mapping[str, slice]) -> None:
        """Adds one view of the whole scene; ``spans``: name of a node -> its rows."""
        for name, instances in self._instances.items():
            largest = self._pixels[name]
            filled = torch.zeros_like(largest).index_add(0, instances.ids, view.weight[spans[name]].to(largest))
            self._pixels[name] = torch.maximum(largest, filled)

    def floors(self, ranks: Ranks = ALONE) -> dict[str, Floors]:
        """Returns name of every node -> its floors, from the views of all ``ranks``.

        Raises ValueError for an area that is not finite.
        """
        self._pixels = {name: ranks.largest(pixels) for name, pixels in self._pixels.items()}
        return {
            name: Floors(node.settings.min_gaussians, self._of_instances(name)) for name, node in self._nodes.items()
        }

    def _of_instances(self, name: str) -> InstanceFloors | None:
        instances = self._instances.get(name)
        if instances is None:
            return None
        pixels = self._pixels[name]
        if not pixels.isfinite().all():
            index = int((~pixels.isfinite()).nonzero()[0])
            raise ValueError(
                f"an instance fills a finite number of pixels, but {instances.names[index]!r} of node {name!r} fills "
                f"{float(pixels[index])}: look for NaN in its Gaussians before pruning"
            )
        least = (self._nodes[name].settings.min_instance_gaussians * pixels / 1000).ceil().long()
        return InstanceFloors(instances.ids, torch.minimum(least, instances.counts()))
