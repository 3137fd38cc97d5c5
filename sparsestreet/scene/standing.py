"""A finished scene between its frames: what stands still is activated once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sparsestreet.ops.activate import activate
from sparsestreet.ops.raw import LEARNED, RawGaussians, harmonics_of
from sparsestreet.scene.effects.effect import Effect
from sparsestreet.scene.graph import SceneGaussians, SceneGraph
from sparsestreet.scene.nodes.node import Node
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.types import Gaussians, View


class StandingScene(SceneGraph):
    """A scene that is shown and not trained, of the modules of another; its frames are the same to the last bit.

    The first nodes stand still if they answer with the parameters that they store, unmasked and unplaced, as a
    background does. Their activated rows stay at the head of a table, and each frame writes the rows of all other nodes
    behind them. So **what a frame got holds until the next frame**, also of a scene that was made of this one with
    other nodes or effects: both share the table. It takes 11 numbers a row: harmonics are read where nodes keep them.

    The rows are activated anew where a parameter is another tensor, has moved, or was changed in place, by torch's own
    count of changes: optimizer steps, ``load_state_dict``, ``to``, ``Rows.resize``. Only what writes past torch, into
    ``.data`` or an array of NumPy, is not seen.
    """

    def __init__(
        self, nodes: Mapping[str, Node], effects: Mapping[str, Effect] | None = None, kept: "_KeptRows | None" = None
    ) -> None:
        super().__init__(nodes, effects)
        self._kept = _KeptRows() if kept is None else kept

    @classmethod
    def of(cls, scene: SceneGraph) -> "StandingScene":
        """The scene, standing; itself where it stands already."""
        made = scene if isinstance(scene, cls) else cls(dict(scene.nodes.items()), dict(scene.effects.items()))
        return made.train(scene.training)

    def gaussians_at(self, view: View, state: SceneState = FINISHED) -> SceneGaussians:
        """Activated Gaussians of all nodes, as ``SceneGraph.gaussians_at`` has them; they hold until the next call.

        Raises ValueError for a state of training, or where gradients are asked for: there are none.
        """
        if state != FINISHED or torch.is_grad_enabled():
            asked = f"{state}" if state != FINISHED else "gradients"
            raise ValueError(f"a standing scene is shown and not trained, got {asked}: render the scene it was made of")
        return super().gaussians_at(view, state)

    def _activated(self, parts: Sequence[RawGaussians], state: SceneState) -> Gaussians:
        still = next((place for place, part in enumerate(parts) if not _stands_still(part)), len(parts))
        if not still:
            return super()._activated(parts, state)
        return self._kept.joined(parts[:still], parts[still:], state.sh_degree)

    def _like(self, nodes: Mapping[str, Node], effects: Mapping[str, Effect]) -> SceneGraph:
        same = next(iter(nodes.values())) is next(iter(self.nodes.values()))
        return StandingScene(nodes, effects, self._kept if same else None)


def _stands_still(part: RawGaussians) -> bool:
    """Whether a node answered with what it stores: no mask, pose or anything else was computed for the view."""
    return all(isinstance(tensor, nn.Parameter) and not tensor.is_inference() for tensor in _stored(part))


def _stored(part: RawGaussians) -> list[Tensor]:
    """The numbers that a part's rows are activated from, those of its mask and poses included."""
    return [tensor for tensor in part.tensors()[:LEARNED] if tensor is not None]


@dataclass(frozen=True)
class _Mark:
    """A parameter as it was when rows were made of it."""

    tensor: Tensor
    address: int
    changes: int

    @staticmethod
    def of(tensor: Tensor) -> "_Mark":
        return _Mark(tensor, tensor.data_ptr(), tensor._version)

    def holds_for(self, tensor: Tensor) -> bool:
        """Whether the tensor is that one, and as it was."""
        return tensor is self.tensor and (tensor.data_ptr(), tensor._version) == (self.address, self.changes)


class _KeptRows:
    """A table with the rows of parts that stand still at its head, and room for other rows behind them."""

    def __init__(self) -> None:
        self._marks: list[_Mark] = []
        self._columns: tuple[Tensor, ...] = ()
        self._head = 0

    def joined(self, still: Sequence[RawGaussians], others: Sequence[RawGaussians], sh_degree: int) -> Gaussians:
        """Activate all parts as ``ops.activate`` does, into the table; the answer is views of it."""
        parts = (*still, *others)
        count = sum(map(len, parts))
        # Outside of inference mode, whose tensors could not be written to in a later frame.
        with torch.inference_mode(False), torch.no_grad():
            if not self._fits(still, count):
                self._make(still, count, sh_degree)
            if others:
                self._write(activate(others, sh_degree=sh_degree), self._head)
        sh = harmonics_of(parts, sh_degree)
        return Gaussians.of_learned((*(column[:count] for column in self._columns), *sh.tables), sh.terms)

    def _fits(self, still: Sequence[RawGaussians], count: int) -> bool:
        stored = [tensor for part in still for tensor in _stored(part)]
        if len(stored) != len(self._marks) or len(self._columns[0]) < count:
            return False
        return all(mark.holds_for(tensor) for mark, tensor in zip(self._marks, stored, strict=True))

    def _make(self, still: Sequence[RawGaussians], count: int, sh_degree: int) -> None:
        rows = activate(still, sh_degree=sh_degree)
        means = rows.means
        self._columns = tuple(means.new_zeros(count, *width) for width in ((3,), (4,), (3,), ()))
        self._write(rows, 0)
        self._head = len(rows)
        self._marks = [_Mark.of(tensor) for part in still for tensor in _stored(part)]

    def _write(self, rows: Gaussians, first: int) -> None:
        """Put rows at a place of the table."""
        numbers = (rows.means, rows.quaternions, rows.scales, rows.opacities)
        for column, values in zip(self._columns, numbers, strict=True):
            column[first : first + len(rows)] = values
