"""Settings and interface shared by all node classes of the scene graph."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.optim import Optimizer

from sparsestreet.ops.activate import activate
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.density import DensityStrategy
from sparsestreet.scene.gaussians import Rows, drop_parameter
from sparsestreet.scene.initialize.gaussians import init_gaussians
from sparsestreet.scene.initialize.points import Points
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.learning_rate import Rates, rates_of, usual_rates
from sparsestreet.scene.masks import Mask, MaskScope, MaskSettings
from sparsestreet.scene.nodes.regularizers import sharp_shape
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Gaussians, Track, View

BYTES_PER_NUMBER = 4
"""Sizes are stated as float32, whatever precision a test or an optimizer holds them in."""


@dataclass(frozen=True, kw_only=True)
class NodeSettings(ABC):
    """Everything that is said about one node class; callbacks, losses and rules read it here and nowhere else.

    Raises ValueError for limits that contradict each other.
    """

    classes: Sequence[str] = ()
    """Class names of the log whose tracks the node takes."""
    min_path_length: float = 0.0
    """Meters; a track that travels no farther is left to the static nodes."""
    has_body_pose: bool | None = None
    """True: only tracks that come with body poses; False: only those without; None: both."""
    min_gaussians: int = 0
    """K_min of the paper: neither masks nor pruning leave fewer Gaussians in the node class."""
    min_instance_gaussians: float = 0.0
    """What pruning leaves of each object: so many Gaussians per 1,000 pixels that it fills in the training view that
    shows it largest, or all that it has."""
    max_gaussians: int | None = None
    """Density control stops here; None: no limit."""
    sh_degree: int = 3
    mask: MaskSettings | None = None
    """None: this node knows no mask."""
    masked: bool = True
    """Whether the mask, if there is one, is trained in this run."""
    density: DensityStrategy | None = None
    """None: the node keeps the Gaussians it starts with."""
    densify_until: float | None = None
    """Fraction of the run after which none are added any more; None: the schedule says."""
    prunable: bool = True
    """Whether pruning rules may take Gaussians of this node."""
    sharp_shape: float = 0.0
    """Weight of the term against needles (see ``regularizers.sharp_shape``); 0: it is not computed."""
    max_axis_ratio: float = 10.0
    """Ratio of a Gaussian's longest to its shortest axis from which that term counts."""
    learning_rates: Rates = field(default_factory=usual_rates)
    """Column, parameter or module of the node -> its rate; the longest name that matches wins. A mapping of its fields
    is taken for a rate and becomes one."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "learning_rates", rates_of(self.learning_rates))
        if self.min_gaussians < 0:
            raise ValueError(f"min_gaussians must be >= 0, got {self.min_gaussians}")
        if not self.min_instance_gaussians >= 0:
            raise ValueError(
                f"min_instance_gaussians must be >= 0 Gaussians per 1,000 pixels, got {self.min_instance_gaussians}"
            )
        if not (self.sharp_shape >= 0 and self.max_axis_ratio >= 1):
            raise ValueError(
                f"sharp_shape is a weight >= 0 and max_axis_ratio a ratio >= 1, got {self.sharp_shape} and "
                f"{self.max_axis_ratio}"
            )
        if self.densify_until is not None and not 0 <= self.densify_until <= 1:
            raise ValueError(f"densify_until is a fraction of the run in [0, 1], got {self.densify_until}")
        if self.max_gaussians is not None and self.max_gaussians < max(self.min_gaussians, 1):
            raise ValueError(
                f"max_gaussians must be at least min_gaussians, got {self.max_gaussians} and {self.min_gaussians}: "
                "raise the first or lower the second"
            )

    def takes(self, track: Track) -> bool:
        """Whether the node claims a track of the log."""
        fits = self.has_body_pose is None or self.has_body_pose == (track.body is not None)
        return fits and track.class_name in self.classes and track.path_length > self.min_path_length

    @property
    def mask_settings(self) -> MaskSettings | None:
        """The mask that is trained in this run, if any."""
        return self.mask if self.masked else None

    @abstractmethod
    def build(self, data: TrainingData, generator: torch.Generator) -> "Node | None":
        """Make the node from what training may see; None where it would have no instance."""

    @abstractmethod
    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Node":
        """The node of a scene file: its table, all its tensors by name, and what ``Node.header`` said."""

    def start(
        self,
        data: TrainingData,
        points: Points,
        scales: Float[Tensor, " n"],
        opacities: Float[Tensor, " n"],
        generator: torch.Generator,
        *,
        columns: Mapping[str, Tensor] | None = None,
        buffers: Mapping[str, Tensor] | None = None,
        scope: MaskScope | None = None,
    ) -> tuple[Rows, Mask | None]:
        """The table of a node that begins, one Gaussian a point, and its mask.

        ``scales`` are meters, ``opacities`` in (0, 1); ``columns`` are learned beside those of every node, ``buffers``
        what else is known of each row; ``scope`` where and when the mask's instances are, None: everywhere, always.
        """
        if scope is None:
            scope = MaskScope.whole(data.times, data.log.center, data.log.radius)
        mask = None if self.mask_settings is None else self.mask_settings.build(self.min_gaussians, scope)
        rows = init_gaussians(
            points.positions,
            points.colors,
            scales,
            opacities=opacities,
            sh_degree=self.sh_degree,
            generator=generator,
            columns=columns,
            mask_columns={} if mask is None else mask.initial_columns(len(points)),
            buffers=buffers,
        )
        return rows, mask


@dataclass(frozen=True)
class Instances:
    """The objects of a node."""

    names: tuple[str, ...]
    """Names of their tracks in the log."""
    ids: Int[Tensor, " n"]
    """Row of the node -> its instance."""
    sizes: Float[Tensor, "i 3"]
    """Length, width, height of their boxes, meters."""

    def counts(self) -> Int[Tensor, " i"]:
        """Number of rows of every instance."""
        return torch.bincount(self.ids, minlength=len(self.names))


class Node(nn.Module, ABC):
    """One node class: a table of Gaussians with an optional mask.

    The rows hold ``means``, ``log_scales``, ``quaternions``, ``opacity_logits``, ``sh_dc`` [n, 1, 3],
    ``sh_rest`` [n, k - 1, 3] and, while a mask is being trained, the mask's columns. They stay unmasked: only
    activation applies the mask, so densification, culling and regularizers see what the mask hides
    (a scale of 0 has no logarithm and no ratio).
    """

    settings: NodeSettings
    rows: Rows
    mask: Mask | None

    def __init__(self, settings: NodeSettings, rows: Rows, mask: Mask | None = None) -> None:
        super().__init__()
        held, wanted = sorted(rows.transient), sorted(mask.columns if mask is not None else ())
        if held != wanted:
            raise ValueError(
                f"a mask and its columns come together, but the mask needs {wanted} and the table has {held}: "
                "make the table with NodeSettings.start, or leave both out"
            )
        self.settings = settings
        self.rows = rows
        self.mask = mask

    @abstractmethod
    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """The node's Gaussians as a view sees them, before activation, and how they are masked and placed.

        A view without frame and camera index is a novel one: it is answered from its time alone.
        """

    def gaussians_at(self, view: View, state: SceneState) -> Gaussians:
        """The node's Gaussians in the world, activated, with the mask applied."""
        return activate([self.raw_at(view, state)], sh_degree=state.sh_degree)

    def own_regularizers(
        self, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        """Terms of the loss that concern the node alone, by name, each with its weight.

        ``raw`` is what the node answered for the view of this step, so that nothing need be computed twice. ``drawn``:
        rows that the view shows. A term that always pulls, at all rows, wins over the image at those that few views
        show: Adam steps by its learning rate however small a lone gradient is.
        """
        return {}

    def regularizers(
        self, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        """``regularizers``, and the terms that every node has whose settings give them a weight."""
        settings = self.settings
        shape = {}
        if settings.sharp_shape > 0:
            # The mask is applied at activation: what it hides has its shape here.
            shape["sharp_shape"] = settings.sharp_shape * sharp_shape(self.rows.log_scales, settings.max_axis_ratio)
        return shape | self.own_regularizers(raw, drawn, state)

    def outside(self) -> Bool[Tensor, " n"] | None:
        """Rows that left the bounds of their instance; None for a node without bounds."""
        return None

    def instances(self) -> Instances | None:
        """The node's objects; None for a node that is no collection of objects."""
        return None

    def header(self) -> dict[str, Any]:
        """What a scene file has to know beside settings and tensors; JSON values only."""
        return {}

    def pose_bytes(self) -> int:
        """float32 bytes of what moves the rows over time; 0 for a node that stands still."""
        return 0

    def stored(self, view: View) -> RawGaussians:
        """The rows as they are learned, with the mask as it is at the time of a view."""
        rows = self.rows
        return RawGaussians(
            rows.means,
            rows.log_scales,
            rows.quaternions,
            rows.opacity_logits,
            rows.sh_dc,
            rows.sh_rest,
            multipliers=None if self.mask is None else self.mask.multipliers(rows, view.time),
        )

    def finish_mask(self, optimizer: Optimizer | None = None) -> None:
        """The mask has done its work: what it learned goes, from the optimizer too, and what it says stays is left.

        A node whose mask is finished already, or that has none, stays as it is.
        """
        if self.mask is None or not self.mask.columns:
            return
        learned, (self.mask, buffers) = self.mask, self.mask.finish(self.rows)
        for name in learned.columns:
            self.rows.drop_column(name, optimizer)
        for parameter in learned.parameters():
            if optimizer is not None:
                drop_parameter(optimizer, parameter)
        for name, values in buffers.items():
            self.rows.register_buffer(name, values)

    def row_bytes(self) -> int:
        """float32 bytes of the rows without their masks (an instance number counts as one number; bits are packed)."""
        columns = self.rows.columns()
        return sum(_bytes(columns[name]) for name in columns.keys() - self.rows.transient)

    def _load_from_state_dict(self, state_dict, prefix, *args) -> None:
        """A checkpoint from after the mask stage comes without the mask's columns: then the mask is finished here too.

        Its rows are those of the start still; what they say is replaced by what the checkpoint says.
        """
        if self.mask is not None and not any(f"{prefix}rows.{name}" in state_dict for name in self.mask.columns):
            self.finish_mask()
        super()._load_from_state_dict(state_dict, prefix, *args)


def _bytes(column: Tensor) -> int:
    return column.numel() * (1 if column.dtype == torch.uint8 else BYTES_PER_NUMBER)
