"""Numbers that are not numbers: found in the step that shows them, and named."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from sparsestreet.host_copy import HostCopy, copy_to_host
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import View

_NAMED = 3
"""Places that an error names."""


class NotFiniteError(ValueError):
    """A loss, a gradient or a parameter is NaN or infinite: training cannot go on from it."""


class LossWatch:
    """Looks at the terms of each loss: in the step itself on the CPU, one step later on a device."""

    def __init__(self) -> None:
        self._pending: tuple[HostCopy, tuple[str, ...], SceneGraph, View, int] | None = None

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
        on_host = terms.device.type == "cpu"
        if not on_host or not bool(terms.detach().sum().isfinite()):
            self._pending = (copy_to_host(terms.detach()), tuple(names), scene, view, step)
        if on_host:
            self.settle()

    def settle(self) -> None:
        """Look at what has not been looked at yet; this may wait. Raises NotFiniteError."""
        pending, self._pending = self._pending, None
        if pending is None:
            return
        terms, names, scene, view, step = pending
        values = terms.wait()
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
    """Raises NotFiniteError, naming node, column and row, where a parameter is not finite: no checkpoint has such."""
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
