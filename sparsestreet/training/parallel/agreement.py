"""Whether all processes train the same scene: counts and checksums, compared where rows change."""

import torch
from torch import Tensor, nn

from sparsestreet.ranks import Ranks
from sparsestreet.scene.graph import SceneGraph


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
