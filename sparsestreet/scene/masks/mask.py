"""What every mask of a node answers."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sparsestreet.scene.gaussians import Rows, Selection


class Mask(nn.Module, ABC):
    """Learned scores of one node's Gaussians: which of them show, and which stay.

    What a mask learns per Gaussian are columns of the node's table, so that they follow every RowPlan; what it learns
    once (a network) are its own parameters.
    """

    columns: tuple[str, ...]
    """Names of the columns that are the mask's; they are dropped when mask training ends."""
    sparsity_weight: float
    """lambda_n of the paper."""
    floor_firings: int = 0
    """How often K_min kept rows open that had fallen below the threshold, since somebody last asked."""

    @abstractmethod
    def initial_columns(self, num_rows: int) -> dict[str, Tensor]:
        """The mask's columns for a table that is being made."""

    @abstractmethod
    def multipliers(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        """M in {0, 1} of every row at a normalized time, for opacity and scale, with a straight-through gradient."""

    @abstractmethod
    def sparsity(self, rows: Rows, time: float, visible: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        """Sum of the scores that the sparsity loss pushes down, in a view of ``time`` that draws the ``visible``."""

    @abstractmethod
    def keep(self, rows: Rows) -> Selection:
        """Which rows are open at any time that training sees; never fewer than the node's K_min."""

    @abstractmethod
    def finish(self, rows: Rows) -> "tuple[Mask | None, dict[str, Tensor]]":
        """What stays of the mask when its training ends and the rows that ``keep`` closes are gone; None: M = 1.

        And what it has to know of every row from then on: buffers of the table. What stays has no columns.
        """


@dataclass(frozen=True)
class MaskScope:
    """Where and when the instances of a node are; a node without instances is one that is everywhere, always.

    Rows belong to the instance that the buffer ``instances`` of their table names, or to the first without one.
    """

    times: Float[Tensor, "i k"]
    """Normalized times of the training frames that show the instance, in order; anything where not valid."""
    valid: Bool[Tensor, "i k"]
    """The valid ones come first; at least one each."""
    centers: Float[Tensor, "i 3"]
    half_sizes: Float[Tensor, "i 3"]
    """Meters, in the frame of the rows: (mean - center) / half size lies in [-1, 1] for most rows."""

    @staticmethod
    def whole(times: Sequence[float], center: Float[Tensor, "3"], radius: float) -> "MaskScope":
        """One instance that fills the scene and is seen at all training times."""
        every = torch.tensor([list(times)], dtype=torch.float32)
        return MaskScope(every, torch.ones_like(every, dtype=torch.bool), center[None], torch.full((1, 3), radius))


@runtime_checkable
class MaskSettings(Protocol):
    """What is configured of a mask."""

    def build(self, min_gaussians: int, scope: MaskScope) -> Mask:
        """A mask that never leaves fewer rows open than ``min_gaussians``, the K_min of its node."""
        ...
