"""The interface of a node's mask."""

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from sparsestreet.geometry.trajectories import TIME_TOLERANCE
from sparsestreet.scene.gaussians import Rows, Selection, keep_best


class Mask(nn.Module, ABC):
    """Learned scores that decide which of a node's Gaussians show, and which stay.

    What a mask learns per Gaussian is a column of the node's table, so it follows every RowPlan. What it learns once (a
    network) is its own parameter.
    """

    columns: tuple[str, ...]
    """Names of the mask's columns; they are dropped when mask training ends."""
    sparsity_weight: float
    """lambda_n of the paper."""
    floor_firings: int | Tensor = 0
    """Number of times that K_min kept rows open below the threshold, since the count was last read; a tensor where
    counting is left to a device."""

    def at_image(self, number: int) -> None:
        """Go to the training image with this number, where steps take several images: their draws follow from it."""

    @abstractmethod
    def initial_columns(self, num_rows: int) -> dict[str, Tensor]:
        """Return the mask's columns for a new table."""

    @abstractmethod
    def multipliers(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        """Return M in {0, 1} of every row at a normalized time, with a straight-through gradient.

        Opacity and scale are multiplied by it.
        """

    def gates(self, rows: Rows, step: int) -> Float[Tensor, " n"] | None:
        """Return a factor in {0, 1} of each row's alpha in a training step, for masks that sample; None: 1.

        Unlike a multiplier, a gate of 0 leaves the row in the lists of the op, so that its gradient exists
        (``ops.splat``).
        """
        return None

    @abstractmethod
    def sparsity(self, rows: Rows, time: float, visible: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        """Return the sum of scores that the sparsity loss lowers; the view at ``time`` draws the ``visible`` rows."""

    @abstractmethod
    def keep(self, rows: Rows) -> Selection:
        """Selects the rows that are open at any training time, never fewer than the node's K_min."""

    @abstractmethod
    def finish(self, rows: Rows) -> "tuple[Mask | None, dict[str, Tensor]]":
        """Return the mask that remains after training, and the buffers of the table that it needs from then on.

        Called when the rows that ``keep`` closes are gone. None stands for M = 1. The remaining mask has no columns.
        """


def check_mask(sparsity_weight: float, threshold: float = 0.0) -> None:
    """Raise ValueError for a negative weight, or a threshold outside [0, 1)."""
    if not sparsity_weight >= 0:
        raise ValueError(f"a mask's sparsity_weight must be >= 0, got {sparsity_weight}")
    if not 0 <= threshold < 1:
        raise ValueError(f"a mask's threshold of a sigmoid must lie in [0, 1), got {threshold}")


@dataclass(frozen=True)
class MaskScope:
    """Where and when the instances of a node are. A node without instances counts as one instance everywhere, always.

    Rows belong to the instance that the table's buffer ``instances`` names, or to the first instance without it.
    """

    times: Float[Tensor, "i k"]
    """Normalized times of the training frames that show the instance, in order; arbitrary where not valid."""
    valid: Bool[Tensor, "i k"]
    """Whether a time is valid; the valid ones come first, at least one for each instance."""
    centers: Float[Tensor, "i 3"]
    half_sizes: Float[Tensor, "i 3"]
    """Meters, in the frame of the rows; (mean - center) / half size lies in [-1, 1] for most rows."""

    @staticmethod
    def whole(times: Sequence[float], center: Float[Tensor, "3"], radius: float) -> "MaskScope":
        """Return one instance that fills the scene and shows at all training times.

        >>> MaskScope.whole([0.0, 0.5, 1.0], torch.zeros(3), radius=20.0).times.tolist()
        [[0.0, 0.5, 1.0]]
        """
        every = torch.tensor([list(times)], dtype=torch.float32)
        return MaskScope(every, torch.ones_like(every, dtype=torch.bool), center[None], torch.full((1, 3), radius))


@runtime_checkable
class MaskSettings(Protocol):
    """The interface of a mask's settings."""

    def build(self, min_gaussians: int, scope: MaskScope) -> Mask:
        """Return a mask that never leaves fewer rows open than ``min_gaussians``, the K_min of its node."""
        ...


BITS = "mask_bits"
"""Buffer of the table: [n, ceil(frames / 8)] uint8, the first frame in the lowest bit of the first byte."""


@dataclass(frozen=True)
class BakedMaskSettings:
    """Settings of a baked mask, which has no options."""

    def restored(self, times: Float[Tensor, " t"]) -> "BakedMask":
        """Return the mask of a scene file, whose table has the bits."""
        return BakedMask(times)


class BakedMask(Mask):
    """M of every row at every training frame; between two frames a row shows if it shows at either.

    Before the first and after the last frame the nearest one counts.
    """

    times: Tensor

    columns = ()
    sparsity_weight = 0.0

    def __init__(self, times: Float[Tensor, " t"]) -> None:
        """``times``: normalized times of the training frames, in order."""
        super().__init__()
        self.settings = BakedMaskSettings()
        self.register_buffer("times", times)

    def initial_columns(self, num_rows: int) -> dict[str, Tensor]:
        return {}

    def multipliers(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        before, after = self._frames_around(time)
        shown = _bit(rows.mask_bits, before)
        if after != before:
            shown = shown | _bit(rows.mask_bits, after)
        return shown.to(rows.means.dtype)

    def sparsity(self, rows: Rows, time: float, visible: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        """Return 0, because nothing is learned any more."""
        return rows.means.new_zeros(())

    def keep(self, rows: Rows) -> Selection:
        """Keep all rows. Those that never show were removed when the mask was finished."""
        everything = torch.ones(len(rows), dtype=torch.bool, device=rows.mask_bits.device)
        return keep_best(everything.float(), ~everything, 0)

    def finish(self, rows: Rows) -> tuple[Mask, dict[str, Tensor]]:
        """Return itself, because it is finished."""
        return self, {}

    def _frames_around(self, time: float) -> tuple[int, int]:
        """Return the frame at a time twice, or the frames before and after it."""
        times = self.times.tolist()
        after = bisect_left(times, time - TIME_TOLERANCE)
        if after == len(times):
            return after - 1, after - 1
        exact = after == 0 or times[after] <= time + TIME_TOLERANCE
        return (after, after) if exact else (after - 1, after)


def packed(shown: Bool[Tensor, "n t"]) -> UInt8[Tensor, "n b"]:
    """Return the bits with eight frames a byte, the first frame in the lowest bit.

    >>> packed(torch.tensor([[True, False, True]])).tolist()
    [[5]]
    """
    rows, frames = shown.shape
    width = -(-frames // 8)
    padded = torch.zeros(rows, 8 * width, dtype=torch.uint8, device=shown.device)
    padded[:, :frames] = shown
    weights = 2 ** torch.arange(8, dtype=torch.uint8, device=shown.device)
    return (padded.reshape(rows, width, 8) * weights).sum(-1, dtype=torch.uint8)


def _bit(bits: UInt8[Tensor, "n b"], frame: int) -> Bool[Tensor, " n"]:
    return (bits[:, frame // 8] >> (frame % 8) & 1).bool()
