"""The one check for numbers that are none: NaN and infinity, in rows from a file, of a scene or of a caller."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor


def check_finite(
    fields: Mapping[str, Shaped[Tensor, "n ..."]],
    remedy: str,
    *,
    unread: Bool[Tensor, " n"] | None = None,
    row: str = "row",
) -> None:
    """Raise ValueError where a number of the rows is NaN or infinite; it names field, row and value.

    Args:
        fields: name -> one entry a row, [n, ...].
        remedy: what the reader of the error is to do.
        unread: rows of which nothing is read, which may hold anything; None: all are read.
        row: what a row is called: "point", "box".
    """
    for name, values in fields.items():
        check_rows(name, values, torch.isfinite(values), "must be finite", remedy, unread=unread, row=row)


def check_rows(
    name: str,
    values: Shaped[Tensor, "n ..."],
    holds: Bool[Tensor, "n ..."],
    invariant: str,
    remedy: str,
    *,
    unread: Bool[Tensor, " n"] | None = None,
    row: str = "row",
) -> None:
    """Raise ValueError for the first row in which ``holds`` is false; as in ``check_finite``."""
    if bool(holds.all()):
        return
    wrong = ~holds if unread is None else ~holds & ~unread.reshape(-1, *[1] * (values.dim() - 1))
    index = wrong.nonzero()[:1].flatten().tolist()
    if index:
        raise ValueError(f"{name} {invariant}, but {row} {index[0]} has {values[tuple(index)].item()}: {remedy}")
