"""A table of Gaussians: every parameter and buffer in it has one entry per row."""

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from sparsestreet.scene.gaussians.plan import RowPlan


class Rows(nn.Module):
    """Named per-row parameters (means, log_scales, mask_logits ...) and buffers (instances ...).

    Raises ValueError if the columns disagree in their number of rows.
    """

    def __init__(self, parameters: dict[str, Tensor], buffers: dict[str, Tensor] | None = None) -> None:
        super().__init__()
        for name, value in parameters.items():
            self.register_parameter(name, nn.Parameter(value.detach().clone()))
        for name, value in (buffers or {}).items():
            self.register_buffer(name, value.clone())
        lengths = {name: column.shape[0] for name, column in self.columns().items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"every column needs the same number of rows, got {lengths}")

    def __len__(self) -> int:
        return next(iter(self.columns().values())).shape[0]

    def columns(self) -> dict[str, Tensor]:
        """All parameters and buffers by name."""
        return dict(self.named_parameters(recurse=False)) | dict(self.named_buffers(recurse=False))

    @torch.no_grad()
    def resize(self, plan: RowPlan, optimizer: Optimizer | None = None) -> None:
        """Apply a plan once, to values, optimiser moments and buffers; gradients are dropped.

        Raises KeyError if the plan edits a column that does not exist (nothing is changed then).
        """
        columns = self.columns()
        unknown = (set(plan.edits) | plan.reset_moments) - set(columns)
        if unknown:
            raise KeyError(f"the plan edits {sorted(unknown)}, but the rows have only {sorted(columns)}")
        for name, column in columns.items():
            value = plan.edits.get(name, column[plan.source]).to(column.dtype)
            if value.shape[0] != plan.source.shape[0]:
                raise ValueError(f"edit of {name!r} has {value.shape[0]} rows, the plan has {plan.source.shape[0]}")
            if isinstance(column, nn.Parameter):
                fresh_parameter = nn.Parameter(value.contiguous().clone(), requires_grad=column.requires_grad)
                setattr(self, name, fresh_parameter)
                if optimizer is not None:
                    zero = torch.ones_like(plan.fresh) if name in plan.reset_moments else plan.fresh
                    _replace_in_optimizer(optimizer, column, fresh_parameter, plan.source, zero)
            else:
                setattr(self, name, value.clone())

    @torch.no_grad()
    def drop_column(self, name: str, optimizer: Optimizer | None = None) -> None:
        """Remove a parameter from the table and from the optimiser (a mask that has done its work)."""
        parameter = self.get_parameter(name)
        delattr(self, name)
        if optimizer is None:
            return
        optimizer.state.pop(parameter, None)
        for group in optimizer.param_groups:
            group["params"] = [other for other in group["params"] if other is not parameter]

    def _load_from_state_dict(self, state_dict, prefix, *args) -> None:
        """Take the number of rows from the checkpoint: a scene is saved with as many as training left it."""
        for name, column in self.columns().items():
            saved = state_dict.get(prefix + name)
            if saved is not None and saved.shape != column.shape:
                value = torch.empty(saved.shape, dtype=column.dtype, device=column.device)
                setattr(self, name, nn.Parameter(value) if isinstance(column, nn.Parameter) else value)
        super()._load_from_state_dict(state_dict, prefix, *args)


def _replace_in_optimizer(optimizer: Optimizer, old: Tensor, new: nn.Parameter, source: Tensor, zero: Tensor) -> None:
    """Put ``new`` where ``old`` was and carry every per-row moment along, zeroed where ``zero``."""
    for group in optimizer.param_groups:
        group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
    state = optimizer.state.pop(old, None)
    if state is None:
        return
    for key, moment in state.items():
        if torch.is_tensor(moment) and moment.shape == old.shape:
            moved = moment[source]
            moved[zero] = 0
            state[key] = moved
    optimizer.state[new] = state
