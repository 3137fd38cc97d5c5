"""Rows whose gradient was not finite: counted, said once, and the end of a run where they are many."""

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from torch import Tensor

from sparsestreet.host_copy import HostCopy, copy_to_host
from sparsestreet.training.adam import RefusedRows
from sparsestreet.training.finite import NotFiniteError, seen_from
from sparsestreet.types import View

log = logging.getLogger(__name__)

SHARE = 0.01
"""Of a column's rows: more of them in one step are no accident of single Gaussians, but a broken image, loss or op. At
one in a hundred, what such a step still learns is what it would have learned."""
FEW = 10
"""Rows that may always rest: in a node of 50 Gaussians half a one would be the share."""
_NAMED = 3
"""Places that a message names."""


@dataclass(frozen=True)
class _Look:
    """At the rows that a step refused."""

    counts: HostCopy
    names: tuple[str, ...]
    rows: tuple[int, ...]
    view: View
    step: int


class Quarantine:
    """Looks at what an optimizer refused: in the step itself on the CPU, one step later on a device.

    A row of a node rests for that step, and training goes on. It ends where more than ``SHARE`` of a column's rows (and
    more than ``FEW``) are refused in one step, or anything of a parameter that is no row of a node.
    """

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        """Node and column -> how often a row of it rested, over all steps."""
        self._ids: tuple[int, ...] = ()
        self._names: tuple[str, ...] = ()
        self._pending: _Look | None = None

    def look(self, refused: RefusedRows, named: Iterable[tuple[str, Tensor]], view: View, step: int) -> None:
        """After a step on ``view``, the ``step``-th. Raises NotFiniteError, on a device for the step before."""
        on_host = refused.counts.device.type == "cpu"
        self.settle()
        if on_host and not bool(refused.counts[:, 0].any()):
            return
        ids = tuple(map(id, refused.parameters))
        if ids != self._ids:  # rows that change are new parameters
            by_id = {id(parameter): name for name, parameter in named}
            self._ids, self._names = ids, tuple(by_id.get(one, "a parameter") for one in ids)
        rows = tuple(len(one) if one.dim() else 1 for one in refused.parameters)
        self._pending = _Look(copy_to_host(refused.counts), self._names, rows, view, step)
        if on_host:
            self.settle()

    def settle(self) -> None:
        """Look at what has not been looked at yet; this may wait. Raises NotFiniteError."""
        look, self._pending = self._pending, None
        if look is None:
            return
        found = [
            (name, rows, count, first)
            for name, rows, (count, first) in zip(look.names, look.rows, look.counts.wait().tolist(), strict=True)
            if count
        ]
        if not found:
            return
        places = [f"{name} row {first:,} ({count:,} of {rows:,} rows)" for name, rows, count, first in found]
        said = ", ".join(places[:_NAMED])
        where = f"step {look.step}, {seen_from(look.view)}"
        if any(not _is_row(name) or count > max(SHARE * rows, FEW) for name, rows, count, _ in found):
            raise NotFiniteError(
                f"{where}: gradients are not finite: {said}. Single rows of a node would rest for the step; these are "
                f"more than {SHARE:.0%} of a column, or no rows of a node. Go on from the newest checkpoint with lower "
                "learning rates, or leave out that frame"
            )
        if not self.counts:
            log.warning(
                "%s: gradients are not finite: %s. Such rows do not step; all are counted, and said at the end",
                where,
                said,
            )
        for name, _, count, _ in found:
            short = name.removeprefix("nodes.").replace(".rows.", ".")
            self.counts[short] = self.counts.get(short, 0) + count

    def state_dict(self) -> Mapping[str, int]:
        return dict(self.counts)

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        self.counts = dict(state)


def _is_row(name: str) -> bool:
    return name.startswith("nodes.") and ".rows." in name
