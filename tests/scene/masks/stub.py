"""A mask that depends on time and learns a module of its own: as little as the contract allows."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sparsestreet.scene.gaussians import Rows, Selection, keep_best
from sparsestreet.scene.masks import Mask, MaskScope, straight_through


@dataclass(frozen=True)
class RisingSettings:
    """A row opens when time passes its ``dawn``; the module shifts all of them."""

    sparsity_weight: float = 0.5
    built_with: list = field(default_factory=list)

    def build(self, min_gaussians: int, scope: MaskScope) -> "RisingMask":
        times = tuple(scope.times[0].tolist())
        self.built_with.append((min_gaussians, times))
        return RisingMask(self.sparsity_weight, min_gaussians, times)


class RisingMask(Mask):
    columns = ("dawn", "slope")

    def __init__(self, sparsity_weight: float = 0.5, min_gaussians: int = 0, times: Sequence[float] = (0.0, 1.0)):
        super().__init__()
        self.sparsity_weight, self.min_gaussians, self.times = sparsity_weight, min_gaussians, tuple(times)
        self.net = nn.Linear(1, 1)
        with torch.no_grad():
            self.net.weight.fill_(0.0)
            self.net.bias.fill_(0.0)

    def initial_columns(self, num_rows: int) -> dict[str, Tensor]:
        return {"dawn": torch.linspace(0.1, 0.9, num_rows), "slope": torch.full((num_rows,), 20.0)}

    def scores(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        shift = self.net(torch.full((1, 1), time)).squeeze()
        return torch.sigmoid(rows.slope * (time - rows.dawn + shift))

    def multipliers(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        return straight_through(self.scores(rows, time), 0.5)

    def sparsity(self, rows: Rows, time: float, visible: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        return self.scores(rows, time).sum()

    def keep(self, rows: Rows) -> Selection:
        best = torch.stack([self.scores(rows, time).detach() for time in self.times]).amax(0)
        return keep_best(best, best <= 0.5, self.min_gaussians)

    def finish(self, rows: Rows) -> tuple[None, dict[str, Tensor]]:
        return None, {}
