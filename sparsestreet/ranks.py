"""The processes that train one scene together, and what they tell each other."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.functional import pad

Item = TypeVar("Item")


class LostProcessError(ConnectionError):
    """Another process does not answer any more: what is in memory is no state to go on from."""


@dataclass(frozen=True)
class Ranks:
    """This process among those that train together. Every method but ``share`` must be called by all of them, in the
    same order; alone, none waits for anybody.

    >>> Ranks().share([1, 2, 3]), list(Ranks(1, 2).share([1, 2, 3]))
    ([1, 2, 3], [2])
    """

    rank: int = 0
    size: int = 1
    moment: Callable[[], str] = lambda: "outside training"
    """Where training stands, for errors."""

    def share(self, items: Sequence[Item]) -> Iterable[Item]:
        """This process's part of work that is spread over all."""
        return items if self.size == 1 else (items[place] for place in range(self.rank, len(items), self.size))

    @torch.no_grad()
    def sum(self, values: Tensor) -> Tensor:
        """Sums over the processes, in place and in their order: one process that adds up the same numbers one after the
        other gets the same bits. Raises LostProcessError, as do all methods below.

        Each process sums a part and hands it to all, which moves as many bytes as a ring's all-reduce.
        """
        if self.size == 1 or not values.numel():
            return values
        given = pad(values.flatten(), (0, -values.numel() % self.size))
        received = torch.empty_like(given)
        with self.answering():
            dist.all_to_all_single(received, given)
            first, *others = received.view(self.size, -1)
            for other in others:
                first += other
            dist.all_gather(list(given.view(self.size, -1)), first)
        return values.copy_(given[: values.numel()].view_as(values))

    @torch.no_grad()
    def largest(self, values: Tensor) -> Tensor:
        """Largest values over the processes, in place."""
        if self.size > 1 and values.numel():
            with self.answering():
                dist.all_reduce(values, dist.ReduceOp.MAX)
        return values

    def gathered(self, value: Any) -> list[Any]:
        """What each process says, in their order; tensors must lie in the host's memory."""
        found = [value] * self.size
        if self.size > 1:
            with self.answering():
                dist.all_gather_object(found, value)
        return found

    @contextmanager
    def answering(self) -> Iterator[None]:
        """Turn the many words of a collective that fails into one sentence."""
        try:
            yield
        except RuntimeError as error:  # all that torch.distributed raises
            reason = (str(error).splitlines() or [""])[0].partition(". ")[0]
            raise LostProcessError(
                f"{self.moment()}: one of the {self.size} processes that train together no longer answers process "
                f"{self.rank}; look for its own error, then go on from the newest checkpoint with resume=RUN ({reason})"
            ) from error


ALONE = Ranks()
