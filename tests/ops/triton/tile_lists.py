"""The lists of tiles with given numbers of pairs, without a scene."""

from collections.abc import Sequence
from unittest.mock import patch

import torch
from torch import Tensor

from sparsestreet.ops.triton import parts as order
from sparsestreet.ops.triton.parts import Parts, Sizes
from tests.ops.scenes import device_of

DEVICE = device_of("triton")


def lists_of(counts: Sequence[int], room: int | None = None) -> tuple[Tensor, Tensor, Tensor, Parts | None]:
    """Begins and ends of the tiles, their order and parts, in room for that many pairs (None: as many as there are).

    Only where tiles are is computed, not the rows of pairs."""
    tiles, pairs = len(counts), sum(counts)
    room = pairs if room is None else room
    keys = torch.full((room,), torch.iinfo(torch.int16).max, dtype=torch.int16)
    keys[:pairs] = torch.arange(tiles, dtype=torch.int16).repeat_interleave(torch.tensor(counts))
    slots, rows = torch.arange(room, device=DEVICE), torch.zeros(room, dtype=torch.int32, device=DEVICE)
    sizes = Sizes(torch.tensor([pairs, 1, 0, pairs, 1], device=DEVICE))
    launch = order.launch

    def over_tiles(kernel, items, *arguments, **options):
        launch(kernel, tiles if kernel is order.bound_tiles else items, *arguments, **options)

    with patch.object(order, "launch", over_tiles):
        _, begins, ends, first_to_last, parts = order.list_by_tile(keys.to(DEVICE), slots, rows, sizes, tiles)
    return begins, ends, first_to_last, parts
