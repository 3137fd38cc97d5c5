"""The result of a trained mask over time: a bit per Gaussian and training frame, without the network."""

from bisect import bisect_left
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from sparsestreet.geometry.trajectories import TIME_TOLERANCE
from sparsestreet.scene.gaussians import Rows, Selection, keep_best
from sparsestreet.scene.masks.mask import Mask

BITS = "mask_bits"
"""Buffer of the table: [n, ceil(frames / 8)] uint8, the first frame in the lowest bit of the first byte."""


@dataclass(frozen=True)
class BakedMaskSettings:
    """Settings of a baked mask, which has no options."""

    def restored(self, times: Float[Tensor, " t"]) -> "BakedMask":
        """Returns the mask of a scene file, whose table has the bits."""
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
        """Returns 0, because nothing is learned any more."""
        return rows.means.new_zeros(())

    def keep(self, rows: Rows) -> Selection:
        """Keeps all rows. Those that never show were removed when the mask was finished."""
        everything = torch.ones(len(rows), dtype=torch.bool, device=rows.mask_bits.device)
        return keep_best(everything.float(), ~everything, 0)

    def finish(self, rows: Rows) -> tuple[Mask, dict[str, Tensor]]:
        """Returns itself, because it is finished."""
        return self, {}

    def _frames_around(self, time: float) -> tuple[int, int]:
        """Returns the frame at a time twice, or the frames before and after it."""
        times = self.times.tolist()
        after = bisect_left(times, time - TIME_TOLERANCE)
        if after == len(times):
            return after - 1, after - 1
        exact = after == 0 or times[after] <= time + TIME_TOLERANCE
        return (after, after) if exact else (after - 1, after)


def packed(shown: Bool[Tensor, "n t"]) -> UInt8[Tensor, "n b"]:
    """Returns the bits with eight frames a byte, the first frame in the lowest bit.

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
