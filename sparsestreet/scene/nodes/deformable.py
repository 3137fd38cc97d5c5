"""Objects that change their shape while they move, such as cyclists (as in OmniRe, Chen et al. 2025)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sparsestreet.geometry.quaternions import normalized
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.nodes.network import DeformationNetwork, NetworkSettings, check_stored
from sparsestreet.scene.nodes.node import BYTES_PER_NUMBER
from sparsestreet.scene.nodes.tracked import Tracked, TrackedSettings
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View


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
        """Builds the node without boxes of frames that have no training image (held out, or outside the range)."""
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
        """Takes the arguments of ``Tracked``; the network starts from seed 0."""
        super().__init__(*args, **keywords)
        for corrections in (self.rotation_deltas, self.translation_deltas):
            corrections.requires_grad_(self.settings.refine_boxes)
        self.start_network(0)

    def start_network(self, seed: int) -> None:
        """Draws weights, and embeddings uniform in [0, 1), from the seed's own stream."""
        features, generator = self.settings.features, torch.Generator().manual_seed(seed)
        self.embeddings = nn.Parameter(torch.rand(len(self.names), features, generator=generator).to(self.sizes))
        self.network = DeformationNetwork(self.settings.network, features, seed).to(self.sizes)

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """Returns every instance's Gaussians, deformed and at its pose; opacity is exactly 0 if it is absent."""
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
        """Returns ``out_of_box``, which replaces a cull because arms and legs may leave a box for a moment."""
        beyond = torch.relu(raw.means.abs() - self.sizes.index_select(0, self.rows.instances) / 2)
        return {"out_of_box": self.settings.outside_weight * beyond.sum() / max(beyond.numel(), 1)}

    def pose_bytes(self) -> int:
        """float32 bytes of keyframes, network and embeddings."""
        learned = sum(parameter.numel() for parameter in (self.embeddings, *self.network.parameters()))
        return super().pose_bytes() + BYTES_PER_NUMBER * learned
