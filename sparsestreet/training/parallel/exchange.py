"""The gradient of a step from those of all processes: only rows that some process saw travel."""

from collections.abc import Sequence
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from sparsestreet.ranks import Ranks
from sparsestreet.training.adam import seen_rows


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
