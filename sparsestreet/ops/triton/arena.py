"""Many vectors in one piece of memory, because an allocation takes the host as long as a short kernel the device."""

from functools import reduce
from operator import or_

import torch
from torch import Tensor

_ALIGNED = 4
"""Numbers of 4 bytes in the 16 that kernels are compiled to expect the beginning of a vector at."""


def vectors(like: Tensor, *lengths: int, dtype: torch.dtype = torch.int32) -> tuple[Tensor, ...]:
    """Unwritten vectors of these lengths, of 4 bytes a number, on the device of ``like``.

    They are freed together, so they should be needed equally long.

    >>> [len(vector) for vector in vectors(torch.zeros(1), 3, 8)]
    [3, 8]
    """
    if not reduce(or_, lengths) % _ALIGNED:
        return like.new_empty(sum(lengths), dtype=dtype).split_with_sizes(lengths)
    pieces, places = [], []
    for length in lengths:
        places.append(len(pieces))
        pieces.append(length)
        if length % _ALIGNED:
            pieces.append(_ALIGNED - length % _ALIGNED)
    found = like.new_empty(sum(pieces), dtype=dtype).split_with_sizes(pieces)
    return tuple(found[place] for place in places)
