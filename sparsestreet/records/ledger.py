"""``records/counts.csv``: how the number of Gaussians of each node changed in a training, and why."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

from sparsestreet.records.file import CsvFile

MASK, PRUNING = "mask", "pruning"
"""Reasons of the changes that make a scene small: masks fell to their threshold, a rule named what may go."""


@dataclass(frozen=True)
class CountChange:
    """A line of the ledger."""

    step: int
    node: str
    before: int
    after: int
    reason: str
    """In a word or two: "start", "densify", "cull", ``MASK``, ``PRUNING`` ..."""


def _change(cells: Sequence[str]) -> CountChange:
    step, node, before, after, reason = cells
    return CountChange(int(step), node, int(before), int(after), reason)


LEDGER = CsvFile(
    "records/counts.csv", tuple(field.name for field in fields(CountChange)), astuple, _change, "train the run"
)
