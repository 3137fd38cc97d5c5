"""Adam that steps only what the step's view has seen."""

from torch import Tensor

from sparsestreet.ops.adam import finite_rows
from sparsestreet.ops.visible_adam import AdamStep, adam_step_
from sparsestreet.training.row_adam import RowAdam


class VisibleAdam(RowAdam):
    """RowAdam whose update leaves a row alone too, moments included, where its gradient is exactly zero.

    A row is an entry of a parameter's first dimension: a Gaussian, of the sky a face, of the poses an object. The splat
    op writes exactly zero for rows that were not drawn, so that the gradient itself says what was seen and no list of
    rows needs to reach the optimizer. It says so per parameter: where a regularizer gives every mask logit a gradient,
    every mask logit steps as in Adam, while the means of the same hidden rows rest. A row that was drawn but hidden by
    others to the last bit rests as well. To look for gradients that are not finite takes this optimizer a pass over
    them.

    ``step`` counts the steps at which the parameter had a gradient at all (see AdamStep.count).
    """

    def _update(
        self, parameter: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], refused: Tensor, step: AdamStep
    ) -> None:
        steps = seen_rows(gradient) & finite_rows(gradient, refused)
        adam_step_(parameter, gradient, *moments, steps, step)


def seen_rows(gradient: Tensor) -> Tensor:
    """Which entries of the first dimension are not all exactly zero, bool [n]."""
    # unflatten gives parameters of one number per row a second dimension as well.
    return gradient.bool().unflatten(0, (-1, 1)).flatten(1).any(1)
