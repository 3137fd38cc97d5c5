"""How much room the lists of a view get before its size is known: a quarter more than the largest view lately took.

So the host queues all kernels of a view without waiting. Only then it reads the view's size. A view that does not fit
is listed as empty, and done again in the room that it takes. Images and gradients are the same in any room.
"""

import torch

from sparsestreet.ops.triton.sizes import Room
from sparsestreet.ops.triton.view import KernelView

_FORGOTTEN = 128
"""The largest view loses this fraction with every other view, so that the room shrinks with the scene.

A view that comes back within 28 others still fits. Too little room costs about one forward pass, too much costs
every sort."""
_seen: dict[tuple, Room] = {}
_repeated = 0


def like(rows: int, view: KernelView, device: torch.device) -> tuple:
    """What views must share to tell each other's size: scenes within a factor of two, among others."""
    return device, view.tiles, rows.bit_length(), view.settings


def predicted(place: tuple, rows: int, limit: int) -> Room | None:
    """Room for a scene of ``rows``; None: nothing is known of views ``like`` this one. At most ``limit`` pairs."""
    most = _seen.get(place)
    if most is None:
        return None
    return Room(min(_with_margin(most.rows), _up(rows)), min(_with_margin(most.pairs), limit))


def remember(place: tuple, rows: int, pairs: int) -> None:
    """What a view took: visible rows and pairs."""
    before = _seen.get(place)
    _seen[place] = Room(rows, pairs) if before is None else Room(_faded(before.rows, rows), _faded(before.pairs, pairs))


def repeated_forwards() -> int:
    """How many forward passes of this process were done twice, because their view did not fit."""
    return _repeated


def count_repeated() -> None:
    global _repeated
    _repeated += 1


def forget() -> None:
    """Forget all views, as at the start of the process."""
    _seen.clear()


def _faded(before: int, taken: int) -> int:
    return max(taken, before - -(-before // _FORGOTTEN))


def _with_margin(count: int) -> int:
    return _up(count + count // 4)


def _up(count: int) -> int:
    """Rounded up to one of eight sizes between two powers of two, so that views like each other take the same room."""
    step = max(16, 1 << max(count.bit_length() - 4, 0))
    return -(-count // step) * step
