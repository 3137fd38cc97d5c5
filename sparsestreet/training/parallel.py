"""Whether all processes train the same scene: counts and checksums, compared where rows change."""

from collections.abc import Callable, Sequence
from datetime import timedelta
from itertools import accumulate, pairwise
from typing import Any

import torch
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor, nn
from torch.optim import Optimizer

from sparsestreet.phases import phase
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.training.adam import seen_rows


class DisagreementError(ValueError):
    """Two processes train different scenes."""


@torch.no_grad()
def check_agreement(scene: SceneGraph, ranks: Ranks) -> None:
    """Compare every node and effect with those of the other processes, bit by bit; alone, nothing happens.

    Raises DisagreementError, which names the first node or effect that differs, and LostProcessError.
    """
    if ranks.size == 1:
        return
    parts = {name: module for group in (scene.nodes, scene.effects) for name, module in group.items()}
    rows = {name: len(node.rows) for name, node in scene.nodes.items()}
    sums = torch.stack([checksum(module).cpu() for module in parts.values()]).tolist()
    said = {name: (rows.get(name, 0), value) for (name, value) in zip(parts, sums, strict=True)}
    for rank, other in enumerate(ranks.gathered(said)):
        wrong = next((name for name in said | other if said.get(name) != other.get(name)), None)
        if wrong is not None:
            own, others = (each.get(wrong, (0, 0))[0] for each in (said, other))
            raise DisagreementError(
                f"{ranks.moment()}: {wrong!r} differs between process {ranks.rank} ({own:,} Gaussians) and process "
                f"{rank} ({others:,}), so they no longer train one scene: use equal devices and versions everywhere, "
                "and go on from the newest checkpoint with resume=RUN"
            )


def checksum(module: nn.Module) -> Tensor:
    """An integer of the bits of all parameters, in their order; int64 [].

    >>> one, other = nn.Linear(1, 2, bias=False), nn.Linear(1, 2, bias=False)
    >>> _ = other.load_state_dict({"weight": one.weight.detach().flip(0)})
    >>> bool(checksum(one) == checksum(one)), bool(checksum(one) == checksum(other))
    (True, False)
    """
    total = torch.zeros((), dtype=torch.int64)
    for parameter in module.parameters():
        bits = parameter.detach().float().contiguous().view(torch.int32).flatten().long()
        # Odd weights by place, so that entries that change places are noticed; integers wrap and do not round.
        places = 2 * torch.arange(len(bits), device=bits.device) + 1
        total = 31 * total.to(bits.device) + (bits * places).sum()
    return total


@torch.no_grad()
def exchange(parameters: Sequence[Tensor], ranks: Ranks, word: int = 0) -> int:
    """Give every parameter the sum of its gradients over the processes.

    Two collectives for all parameters together: the largest of a byte for each row (an entry of a parameter's first
    dimension: a Gaussian, a face of the sky, a row of a network's weights) says which rows any process has a gradient
    for, then the gradients of these rows are summed in one buffer. A parameter that has a gradient in one process
    alone gets one in all, so that Adam counts its steps alike everywhere.

    Args:
        parameters: on one device, in the same order in all processes.
        ranks: the processes.
        word: a number from 0 to 255 that travels along.

    Returns:
        The largest word of any process.

    Raises:
        LostProcessError: if a process does not answer.
    """
    heads = [word, *(parameter.grad is not None for parameter in parameters)]
    lengths = [_rows(parameter).shape[0] for parameter in parameters]
    device = parameters[0].device
    head = torch.tensor(heads, dtype=torch.uint8, device=device)
    marks = ranks.largest(torch.cat([head, *map(_marks, parameters)]))

    seen = torch.nonzero(marks[len(heads) :]).squeeze(-1)
    starts = [0, *accumulate(lengths)]
    places = torch.searchsorted(seen, torch.tensor(starts, device=device))
    said = torch.cat([marks[: len(heads)].long(), places]).tolist()  # the one wait for the device, with nonzero
    word, present, ends = said[0], said[1 : len(heads)], said[len(heads) :]

    rows = [seen[begin:end] - start for (begin, end), start in zip(pairwise(ends), starts[:-1], strict=True)]
    for parameter, is_present in zip(parameters, present, strict=True):
        if is_present and parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
    chosen = [(_rows(one.grad), own) for one, own in zip(parameters, rows, strict=True) if one.grad is not None]
    if chosen:
        packed = ranks.sum(torch.cat([gradient[own].flatten() for gradient, own in chosen]))
        sizes = [len(own) * gradient[:1].numel() for gradient, own in chosen]
        for (gradient, own), values in zip(chosen, packed.split(sizes), strict=True):
            gradient.index_copy_(0, own, values.view(-1, *gradient.shape[1:]))
    return word


def _rows(values: Tensor) -> Tensor:
    """A number is one row."""
    return values if values.dim() else values.view(1)


def _marks(parameter: Tensor) -> Tensor:
    """1 for the rows of which this process has a gradient."""
    if parameter.grad is None or not parameter.numel():
        return torch.zeros(_rows(parameter).shape[0], dtype=torch.uint8, device=parameter.device)
    return seen_rows(_rows(parameter.grad)).to(torch.uint8)


class DataParallel(DDPStrategy):
    """Lightning's DDP without its wrapper: that keeps buckets of parameters, and rows change.

    Launchers, process groups (gloo on CPUs, NCCL on GPUs) and barriers are Lightning's. The gradient of a step is the
    mean over the images of all processes, as it is in one process over ``accumulate_grad_batches`` of them.
    """

    ranks: Ranks = ALONE
    wish: int = 0
    """Number of a signal after which this process wants all to stop; 0: none."""
    agreed: int = 0
    """What the processes agreed on in the last step."""

    def __init__(self, patience: float = 1800.0, **kwargs: Any) -> None:
        """``patience``: seconds until a process that is there and does not answer counts as lost; the first wait is
        for the others to read their data. A process that dies is noticed at once on CPUs, and by what started the
        processes (Lightning, torchrun, SLURM) everywhere.
        """
        if not patience > 0:
            raise ValueError(f"patience must be above 0 seconds, got {patience}")
        super().__init__(timeout=timedelta(seconds=patience), **kwargs)

    def configure_ddp(self) -> None:
        """No wrapper."""

    def setup_distributed(self) -> None:
        super().setup_distributed()
        self.ranks = Ranks(self.global_rank, self.world_size, self._moment)

    def on_train_start(self) -> None:
        check_agreement(self._system().scene, self.ranks)

    def backward(self, closure_loss: Tensor, optimizer: Optimizer | None, *args: Any, **kwargs: Any) -> Tensor:
        return super().backward(closure_loss / self.world_size, optimizer, *args, **kwargs)

    def optimizer_step(self, optimizer: Optimizer, closure: Callable[[], Any], model: Any = None, **kwargs: Any) -> Any:
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]

        def of_all() -> Any:
            loss = closure()
            with phase("exchange"):
                self.agreed = exchange(parameters, self.ranks, self.wish)
            return loss

        return super().optimizer_step(optimizer, of_all, model, **kwargs)

    def barrier(self, *args: Any, **kwargs: Any) -> None:
        with self.ranks.answering():
            super().barrier(*args, **kwargs)

    def broadcast(self, obj: Any, src: int = 0) -> Any:
        with self.ranks.answering():
            return super().broadcast(obj, src)

    def _moment(self) -> str:
        return f"after step {self._system().trainer.global_step}"

    def _system(self) -> Any:
        return self.lightning_module
