"""A table of Gaussians, in which every parameter and buffer has one entry per row."""

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from sparsestreet.scene.gaussians.plan import RowPlan


class Rows(nn.Module):
    """Named per-row parameters (means, log_scales, mask_logits ...) and buffers (instances ...).

    Raises ValueError without any column, or if the columns disagree in their number of rows.

    >>> rows = Rows({"means": torch.zeros(3, 3)}, buffers={"instances": torch.tensor([0, 0, 1])})
    >>> len(rows), sorted(rows.columns())
    (3, ['instances', 'means'])
    """

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor: ...  # every column is one

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        buffers: Mapping[str, Tensor] | None = None,
        transient: Collection[str] = (),
    ) -> None:
        """``transient``: columns that training may drop (those of a mask); a checkpoint may lack them."""
        super().__init__()
        self.transient = frozenset(transient)
        for name, value in parameters.items():
            self.register_parameter(name, nn.Parameter(value.detach().clone()))
        for name, value in (buffers or {}).items():
            self.register_buffer(name, value.clone())
        lengths = {name: column.shape[0] for name, column in self.columns().items()}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"a table needs columns, all of the same number of rows, got {lengths}")

    def __len__(self) -> int:
        return next(iter(self.columns().values())).shape[0]

    def columns(self) -> dict[str, Tensor]:
        """Returns all parameters and buffers by name."""
        return dict(self.named_parameters(recurse=False)) | dict(self.named_buffers(recurse=False))

    @torch.no_grad()
    def resize(self, plan: RowPlan, optimizer: Optimizer | None = None) -> None:
        """Applies a plan to values, optimizer moments and buffers, and drops gradients.

        Raises ValueError if the plan was made for another number of rows, edits a column in another shape, or if the
        optimizer lacks a trainable column; KeyError if it edits an unknown column. An error changes nothing.

        >>> rows = Rows({"opacity_logits": torch.tensor([1.0, 2.0, 3.0])})
        >>> rows.resize(RowPlan.keep(torch.tensor([True, False, True])))
        >>> rows.opacity_logits.tolist()
        [1.0, 3.0]
        """
        columns = self.columns()
        self._check(plan, optimizer)
        for name, column in columns.items():
            value = plan.edits.get(name, column[plan.source]).to(column.dtype).clone()
            if not isinstance(column, nn.Parameter):
                setattr(self, name, value)
                continue
            parameter = nn.Parameter(value.contiguous(), requires_grad=column.requires_grad)
            setattr(self, name, parameter)
            if optimizer is not None and column.requires_grad:
                zero = torch.ones_like(plan.fresh) if name in plan.reset_moments else plan.fresh
                inherited = {"exp_avg_sq"} if name in plan.inherited_second_moments - plan.reset_moments else set()
                _replace_in_optimizer(optimizer, column, parameter, plan.source, zero, inherited)

    @torch.no_grad()
    def drop_column(self, name: str, optimizer: Optimizer | None = None) -> None:
        """Removes a parameter from the table and from the optimizer (the column of a finished mask)."""
        parameter = self.get_parameter(name)
        delattr(self, name)
        if optimizer is not None:
            drop_parameter(optimizer, parameter)

    def _check(self, plan: RowPlan, optimizer: Optimizer | None) -> None:
        columns = self.columns()
        if plan.rows != len(self):
            raise ValueError(f"the plan was made for {plan.rows} rows, the table has {len(self)}: plan again")
        parameters = {name for name, column in columns.items() if isinstance(column, nn.Parameter)}
        unknown = (set(plan.edits) - set(columns)) | ((plan.reset_moments | plan.inherited_second_moments) - parameters)
        if unknown:
            raise KeyError(f"the plan edits {sorted(unknown)}, but the rows have only {sorted(columns)}")
        for name, value in plan.edits.items():
            wanted = (len(plan.source), *columns[name].shape[1:])
            if tuple(value.shape) != wanted:
                raise ValueError(f"the edit of {name!r} has shape {tuple(value.shape)}, the plan needs {wanted}")
        if optimizer is None:
            return
        held = {id(parameter) for group in optimizer.param_groups for parameter in group["params"]}
        missing = [name for name in sorted(parameters) if columns[name].requires_grad and id(columns[name]) not in held]
        if missing:
            raise ValueError(f"the optimizer does not hold the columns {missing}: build it after the scene was loaded")

    def _load_from_state_dict(self, state_dict, prefix, *args) -> None:
        """Takes the number of rows from the checkpoint, and drops transient columns that it lacks.

        Load before you build an optimizer, because parameters of another length are replaced.
        """
        for name, column in self.columns().items():
            saved = state_dict.get(prefix + name)
            if saved is None and name in self.transient:
                delattr(self, name)
            elif saved is not None and saved.shape[1:] == column.shape[1:] and len(saved) != len(column):
                value = torch.empty(saved.shape, dtype=column.dtype, device=column.device)
                is_parameter = isinstance(column, nn.Parameter)
                setattr(self, name, nn.Parameter(value, column.requires_grad) if is_parameter else value)
        super()._load_from_state_dict(state_dict, prefix, *args)


def drop_parameter(optimizer: Optimizer, parameter: Tensor) -> None:
    """Removes a parameter and its moments from an optimizer; does nothing if the optimizer does not hold it."""
    optimizer.state.pop(parameter, None)
    for group in optimizer.param_groups:
        group["params"] = [other for other in group["params"] if other is not parameter]
    optimizer.param_groups[:] = [group for group in optimizer.param_groups if group["params"]]


def _replace_in_optimizer(
    optimizer: Optimizer, old: Tensor, new: nn.Parameter, source: Tensor, zero: Tensor, inherited: Collection[str]
) -> None:
    """Puts ``new`` in the place of ``old`` and carries every per-row moment along, set to 0 where ``zero`` is true,
    except for those that are ``inherited``."""
    for group in optimizer.param_groups:
        group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
    state = optimizer.state.pop(old, None)
    if state is None:
        return
    for key, moment in state.items():
        if torch.is_tensor(moment) and moment.shape == old.shape:
            moved = moment[source]
            if key not in inherited:
                moved[zero] = 0
            state[key] = moved
    optimizer.state[new] = state
