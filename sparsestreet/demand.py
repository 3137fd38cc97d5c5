"""Errors of an input that asks for too much: their own kind, which commands and the server know. No torch."""

import re

_NO_MEMORY = re.compile(r"(not enough|out of|insufficient|no) memory", re.IGNORECASE)


class DemandError(RuntimeError):
    """What was asked for takes more than this machine has, or an op may hold; the sentence ends with the remedy."""


def as_demand(error: BaseException) -> DemandError | None:
    """Return an error by which Python, numpy, torch, OpenCV or our op say that memory is out as one; None: another.

    >>> as_demand(RuntimeError("CUDA out of memory"))
    DemandError('memory is out (CUDA out of memory): ask for smaller images or fewer Gaussians')
    >>> as_demand(KeyError("memory")) is None
    True
    """
    if isinstance(error, DemandError):
        return error
    if not isinstance(error, MemoryError) and not _NO_MEMORY.search(str(error)):
        return None
    said = " ".join(str(error).split())[:300]
    return DemandError(f"memory is out{f' ({said})' if said else ''}: ask for smaller images or fewer Gaussians")
