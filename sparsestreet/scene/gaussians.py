"""The table of a node's Gaussians: which columns it has, its rows, and what happens to them when rows come and go."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.optim import Optimizer

INTENSITIES = "intensities"
"""Column of lidar intensities, which is there once they are learned (``scene.intensities``)."""


@dataclass(frozen=True)
class RowPlan:
    """A plan by which new row i is a copy of old row source[i]; parameters, optimizer moments and buffers follow it.

    Raises ValueError if a source is not a row of the table that the plan was made for.

    >>> plan = RowPlan(rows=2, source=torch.tensor([0, 1, 1]), fresh=torch.tensor([False, False, True]))
    >>> len(plan.source)
    3
    """

    rows: int
    """Number of rows of the table that the plan was made for; a stale plan must not be applied to another table."""
    source: Int[Tensor, " new"]
    fresh: Bool[Tensor, " new"]
    """Whether a new row's optimizer moments start at zero."""
    edits: dict[str, Tensor] = field(default_factory=dict)
    """Name of a parameter or buffer -> values [new, ...] that replace its column, for rows that are not copies."""
    reset_moments: frozenset[str] = frozenset()
    """Names of parameters whose moments start at zero in every row (an opacity reset)."""
    inherited_second_moments: frozenset[str] = frozenset()
    """Names of parameters of which fresh rows begin with their source's second moments. With zeros, which Adam takes
    for true after its first thousand steps, one gradient moves a parameter by 0.1 / sqrt(0.001) = 3.2 rates at once,
    and by 32 until its first moment has died away."""

    def __post_init__(self) -> None:
        if len(self.source) != len(self.fresh):
            raise ValueError(f"fresh must have one entry per new row: {len(self.fresh)} for {len(self.source)}")
        if len(self.source) and not 0 <= int(self.source.min()) <= int(self.source.max()) < self.rows:
            low, high = int(self.source.min()), int(self.source.max())
            raise ValueError(f"the plan's sources {low} to {high} must lie in the table of {self.rows} rows")

    @staticmethod
    def keep(mask: Bool[Tensor, " old"]) -> "RowPlan":
        """Return the plan that keeps the rows where ``mask`` is true, in order.

        >>> RowPlan.keep(torch.tensor([True, False, True])).source.tolist()
        [0, 2]
        """
        source = torch.nonzero(mask).squeeze(-1)
        return RowPlan(len(mask), source, torch.zeros_like(source, dtype=torch.bool))

    def reordered(self, order: Int[Tensor, " new"]) -> "RowPlan":
        """Return the plan whose new row i is this one's new row order[i].

        >>> RowPlan.keep(torch.tensor([True, False, True])).reordered(torch.tensor([1, 0])).source.tolist()
        [2, 0]
        """
        edits = {name: values[order] for name, values in self.edits.items()}
        return replace(self, source=self.source[order], fresh=self.fresh[order], edits=edits)


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

    @staticmethod
    def of(columns: Mapping[str, Tensor]) -> "Rows":
        """Return a table in which columns of floating point are parameters, and others buffers."""
        learned = {name: column for name, column in columns.items() if column.is_floating_point()}
        return Rows(learned, {name: column for name, column in columns.items() if name not in learned})

    def __len__(self) -> int:
        return next(iter(self.columns().values())).shape[0]

    def columns(self) -> dict[str, Tensor]:
        """Return all parameters and buffers by name."""
        return dict(self.named_parameters(recurse=False)) | dict(self.named_buffers(recurse=False))

    @torch.no_grad()
    def resize(self, plan: RowPlan, optimizer: Optimizer | None = None) -> None:
        """Apply a plan to values, optimizer moments and buffers, and drops gradients.

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
        """Remove a parameter from the table and from the optimizer (the column of a finished mask)."""
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
        """Take the number of rows from the checkpoint, drop transient columns that it lacks, add intensities it has.

        Load before you build an optimizer, because parameters of another length are replaced.
        """
        columns = self.columns()
        if (learned := state_dict.get(prefix + INTENSITIES)) is not None:
            device = next(iter(columns.values())).device
            self.register_buffer(INTENSITIES, torch.empty_like(learned, device=device))
        for name, column in columns.items():
            saved = state_dict.get(prefix + name)
            if saved is None and name in self.transient:
                delattr(self, name)
            elif saved is not None and saved.shape[1:] == column.shape[1:] and len(saved) != len(column):
                value = torch.empty(saved.shape, dtype=column.dtype, device=column.device)
                is_parameter = isinstance(column, nn.Parameter)
                setattr(self, name, nn.Parameter(value, column.requires_grad) if is_parameter else value)
        super()._load_from_state_dict(state_dict, prefix, *args)


def drop_parameter(optimizer: Optimizer, parameter: Tensor) -> None:
    """Remove a parameter and its moments from an optimizer; does nothing if the optimizer does not hold it."""
    optimizer.state.pop(parameter, None)
    for group in optimizer.param_groups:
        group["params"] = [other for other in group["params"] if other is not parameter]
    optimizer.param_groups[:] = [group for group in optimizer.param_groups if group["params"]]


def _replace_in_optimizer(
    optimizer: Optimizer, old: Tensor, new: nn.Parameter, source: Tensor, zero: Tensor, inherited: Collection[str]
) -> None:
    """Put ``new`` in the place of ``old`` and carries every per-row moment along, set to 0 where ``zero`` is true,
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


@dataclass(frozen=True)
class Selection:
    """The rows that stay."""

    keep: Bool[Tensor, " n"]
    floor_hit: bool
    """Whether K_min or the floor of an instance kept rows that the rule wanted to remove."""
    removed: int

    def plan(self) -> RowPlan:
        """Return the plan that keeps these rows in order, with their optimizer moments."""
        return RowPlan.keep(self.keep)


@dataclass(frozen=True)
class InstanceFloors:
    """The least number of rows of each instance of a node; an instance that has fewer keeps all."""

    ids: Int[Tensor, " n"]
    """Row -> its instance."""
    least: Int[Tensor, " i"]


def keep_best(
    scores: Float[Tensor, " n"],
    unwanted: Bool[Tensor, " n"],
    min_gaussians: int,
    instances: InstanceFloors | None = None,
) -> Selection:
    """Drops the unwanted rows, but keeps enough of them to meet the floors.

    Each instance first fills up to its own floor. Then the best of the rest fill up to ``min_gaussians``. The highest
    scores stay and, among rows of equal score, the lower row. Raises ValueError for scores that are NaN or a negative
    floor.

    >>> scores = torch.tensor([0.9, 0.1, 0.2])
    >>> selection = keep_best(scores, unwanted=scores < 0.5, min_gaussians=2)
    >>> selection.keep.tolist(), selection.floor_hit, selection.removed
    ([True, False, True], True, 1)
    """
    if min_gaussians < 0:
        raise ValueError(f"min_gaussians must be >= 0, got {min_gaussians}")
    if scores.isnan().any():
        row = int(scores.isnan().nonzero()[0])
        raise ValueError(f"scores must be numbers, but row {row} of {scores.shape[0]} is NaN: repair it before pruning")
    best_first = torch.sort(scores, descending=True, stable=True).indices
    best_first = best_first[torch.sort(unwanted[best_first].byte(), stable=True).indices]
    keep = ~unwanted
    wanted = int(keep.sum())
    if instances is not None:
        keep[best_first[_within_floors(instances.ids[best_first], instances.least)]] = True
    missing = max(min_gaussians - int(keep.sum()), 0)
    keep[best_first[~keep[best_first]][:missing]] = True
    kept = int(keep.sum())
    return Selection(keep, floor_hit=kept > wanted, removed=scores.shape[0] - kept)


def _within_floors(ids: Int[Tensor, " n"], least: Int[Tensor, " i"]) -> Bool[Tensor, " n"]:
    """Return whether each row is within its instance's floor, counted from the first row; rows come best first."""
    by_instance = torch.sort(ids, stable=True)
    counts = torch.bincount(ids, minlength=len(least))
    place = torch.arange(len(ids), device=ids.device) - (counts.cumsum(0) - counts)[by_instance.values]
    within = torch.zeros_like(ids, dtype=torch.bool)
    within[by_instance.indices] = place < least[by_instance.values]
    return within
