"""``records/counts.csv``: each change of a node's number of Gaussians in training, with its reason."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

from sparsestreet.records.file import CsvFile

MASK, PRUNING = "mask", "pruning"
"""Reasons of the changes that make a scene small: a mask closed Gaussians, or a pruning rule selected them."""


@dataclass(frozen=True)
class CountChange:
    """A line of the ledger."""

    step: int
    node: str
    before: int
    after: int
    reason: str
    """A word or two: "start", "densify", "cull", ``MASK``, ``PRUNING`` ..."""


def _change(cells: Sequence[str]) -> CountChange:
    step, node, before, after, reason = cells
    return CountChange(int(step), node, int(before), int(after), reason)


LEDGER = CsvFile(
    "records/counts.csv",
    tuple(field.name for field in fields(CountChange)),
    lambda change: astuple(change),  # as it stands, astuple has two types
    _change,
    "train the run",
)
