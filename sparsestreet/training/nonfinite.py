"""Non-finite values: losses are watched, rows with a NaN rest, and logs do not wait for the GPU."""

import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from lightning import Trainer
from torch import Tensor

from sparsestreet.host_copy import HostCopy, copy_to_host
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.training.adam import RefusedRows
from sparsestreet.training.lightning import log_numbers, logged_number
from sparsestreet.types import View

_NAMED = 3
"""Places that an error names."""


class NotFiniteError(ValueError):
    """A loss, a gradient or a parameter is NaN or infinite: training cannot go on from it."""


class _Watch:
    """Looks at numbers: in the step itself on the CPU, one step later on a device."""

    def __init__(self) -> None:
        self._pending: tuple[HostCopy, tuple[Any, ...]] | None = None

    def settle(self) -> None:
        """Look at what has not been looked at yet; this may wait. Raises NotFiniteError."""
        pending, self._pending = self._pending, None
        if pending is not None:
            numbers, known = pending
            self._judge(numbers.wait(), *known)

    def _keep(self, numbers: Tensor, *known: Any) -> None:
        self._pending = copy_to_host(numbers), known
        if numbers.device.type == "cpu":
            self.settle()

    def _judge(self, numbers: Tensor, *known: Any) -> None:
        raise NotImplementedError


class LossWatch(_Watch):
    """Looks at the terms of each loss."""

    def look(self, names: Iterable[str], terms: Tensor, scene: SceneGraph, view: View, step: int) -> None:
        """Before anything is learned from the ``step``-th step. Raises NotFiniteError, on a device for the step before.

        Args:
            names: of the terms.
            terms: [terms].
            scene: is searched for parameters that are not finite, once a term is not.
            view: that was rendered.
            step: number of the step.
        """
        self.settle()
        # One number is looked at in a step whose loss is finite.
        if terms.device.type != "cpu" or not bool(terms.detach().sum().isfinite()):
            self._keep(terms.detach(), tuple(names), scene, view, step)

    def _judge(self, values: Tensor, names: tuple[str, ...], scene: SceneGraph, view: View, step: int) -> None:
        if bool(values.sum().isfinite()):
            return
        wrong = [f"{name} = {value:g}" for name, value in zip(names, values.tolist(), strict=True)
                 if not math.isfinite(value)]  # fmt: skip
        places = not_finite(scene.named_parameters())
        said = f"; parameters: {', '.join(places)}" if places else "; all parameters are finite"
        raise NotFiniteError(
            f"step {step}: the loss of {seen_from(view)} is not finite ({', '.join(wrong) or 'their sum'}){said}. "
            "The newest checkpoint is from before it: lower learning rates, or leave out that frame"
        )


def check_parameters(named: Iterable[tuple[str, Tensor]], step: int) -> None:
    """Raise NotFiniteError, naming node, column and row, where a parameter is not finite: no checkpoint has such."""
    if places := not_finite(named):
        raise NotFiniteError(
            f"after step {step} parameters are not finite: {', '.join(places)}. The newest checkpoint is from before: "
            "go on from there with lower learning rates"
        )


@torch.no_grad()
def not_finite(named: Iterable[tuple[str, Tensor]]) -> list[str]:
    """The first places that are not finite: parameter, row and how many of its rows.

    >>> rows = torch.zeros(4, 3)
    >>> rows[2, 1] = torch.nan
    >>> not_finite([("nodes.background.rows.means", rows)])
    ['nodes.background.rows.means row 2 (1 of 4 rows)']
    """
    found = []
    for name, values in named:
        # A sum is one pass without a table of flags; it may overflow, so it only says where to look.
        if not values.numel() or bool(values.sum().isfinite()):
            continue
        bad = ~values.isfinite().reshape(len(values), -1).all(1) if values.dim() else ~values.isfinite()[None]
        if bool(bad.any()):
            row = int(bad.int().argmax())
            found.append(f"{name} row {row:,} ({int(bad.sum()):,} of {len(bad):,} rows)")
    return found[:_NAMED]


def seen_from(view: View) -> str:
    """The view in words."""
    frame = "a view of no frame" if view.frame_index is None else f"frame {view.frame_index}"
    return frame if view.camera_index is None else f"{frame}, camera {view.camera_index}"


@dataclass(frozen=True)
class _Step:
    """What one step says."""

    number: int
    filed: int
    """Under which number the loggers file it."""
    epoch: int
    names: tuple[str, ...]
    values: HostCopy
    known: Mapping[str, float]
    """What the host knows already."""

    def arrived(self) -> dict[str, float]:
        """By name; waits for the copy."""
        return dict(zip(self.names, self.values.wait().tolist(), strict=True)) | dict(self.known)


class SaidLater:
    """Keeps what the newest step that logs has said until somebody passes it on."""

    def __init__(self) -> None:
        self._step: _Step | None = None
        self._newest: dict[str, float] = {}

    def say(self, trainer: Trainer, values: Mapping[str, Tensor], known: Mapping[str, float]) -> None:
        """Queue the copies of a step's numbers; of several images of a step the last is heard."""
        numbers = torch.stack([value.detach().double() for value in values.values()])
        place = trainer.global_step, logged_number(trainer), trainer.current_epoch
        self._step = _Step(*place, tuple(values), copy_to_host(numbers), known)

    def pass_on(self, trainer: Trainer) -> None:
        """Hand what an earlier step has said to Lightning's loggers, under that step; waits if it is not there yet."""
        if self._step is not None and self._step.number < trainer.global_step:
            step, self._step = self._step, None
            self._newest = step.arrived()
            numbers: dict[str, Any] = {**self._newest, "epoch": step.epoch}
            log_numbers(trainer, numbers, step.filed)

    @property
    def is_there(self) -> bool:
        """Whether there is something to pass on, and it has arrived."""
        return self._step is not None and self._step.values.ready

    @property
    def newest(self) -> Mapping[str, float]:
        """What has arrived last, without a wait."""
        return self._newest if self._step is None or not self.is_there else self._step.arrived()


log = logging.getLogger(__name__)

SHARE = 0.01
"""Of a column's rows: more of them in one step are no accident of single Gaussians, but a broken image, loss or op. At
one in a hundred, what such a step still learns is what it would have learned."""
FEW = 10
"""Rows that may always rest: in a node of 50 Gaussians half a one would be the share."""


class Quarantine(_Watch):
    """Looks at what an optimizer refused.

    A row of a node rests for that step, and training goes on. It ends where more than ``SHARE`` of a column's rows (and
    more than ``FEW``) are refused in one step, or anything of a parameter that is no row of a node.
    """

    def __init__(self) -> None:
        super().__init__()
        self.counts: dict[str, int] = {}
        """Node and column -> how often a row of it rested, over all steps."""
        self._ids: tuple[int, ...] = ()
        self._names: tuple[str, ...] = ()

    def look(self, refused: RefusedRows, named: Iterable[tuple[str, Tensor]], view: View, step: int) -> None:
        """After a step on ``view``, the ``step``-th. Raises NotFiniteError, on a device for the step before."""
        self.settle()
        if refused.counts.device.type == "cpu" and not bool(refused.counts[:, 0].any()):
            return
        ids = tuple(map(id, refused.parameters))
        if ids != self._ids:  # rows that change are new parameters
            by_id = {id(parameter): name for name, parameter in named}
            self._ids, self._names = ids, tuple(by_id.get(one, "a parameter") for one in ids)
        rows = tuple(len(one) if one.dim() else 1 for one in refused.parameters)
        self._keep(refused.counts, self._names, rows, view, step)

    def _judge(self, counts: Tensor, names: tuple[str, ...], lengths: tuple[int, ...], view: View, step: int) -> None:
        found = [
            (name, rows, count, first)
            for name, rows, (count, first) in zip(names, lengths, counts.tolist(), strict=True)
            if count
        ]
        if not found:
            return
        places = [f"{name} row {first:,} ({count:,} of {rows:,} rows)" for name, rows, count, first in found]
        said = ", ".join(places[:_NAMED])
        where = f"step {step}, {seen_from(view)}"
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
