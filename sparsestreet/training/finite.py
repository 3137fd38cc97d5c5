"""Numbers that are not numbers: found in the step that shows them, and named."""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import View

_NAMED = 3
"""Places that an error names."""


class NotFiniteError(ValueError):
    """A loss, a gradient or a parameter is NaN or infinite: training cannot go on from it."""


def check_loss(terms: Mapping[str, Tensor], scene: SceneGraph, view: View, step: int) -> None:
    """Raises NotFiniteError where the sum of a step's terms is not finite, before anything is learned from it.

    It names the terms, the view, and the parameters that are not finite. One number is looked at in a step whose loss
    is finite; on a GPU that would wait for the device, so there only ``check_parameters`` speaks.
    """
    if all(term.device.type == "cpu" for term in terms.values()):
        if bool(torch.stack([term.detach() for term in terms.values()]).sum().isfinite()):
            return
        wrong = [f"{name} = {float(term.detach()):g}" for name, term in terms.items() if not term.detach().isfinite()]
        frame = "a view of no frame" if view.frame_index is None else f"frame {view.frame_index}"
        camera = "" if view.camera_index is None else f", camera {view.camera_index}"
        places = not_finite(scene.named_parameters())
        said = f"; parameters: {', '.join(places)}" if places else "; all parameters are finite"
        raise NotFiniteError(
            f"step {step + 1}: the loss of {frame}{camera} is not finite ({', '.join(wrong) or 'their sum'}){said}. "
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
