"""Nodes of an edited scene: a node whose objects go other ways, and one object more."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.ops.raw import Placement, Poses, RawGaussians
from sparsestreet.scene.edits.paths import Frame, Path, Recorded
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.nodes.node import Instances, Node
from sparsestreet.scene.nodes.tracked import Tracked, moved_by_boxes
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View

ALWAYS = (float("-inf"), float("inf"))


@dataclass(frozen=True)
class Change:
    """What becomes of one object."""

    path: Path | None = None
    """Where it is; None: as recorded, and only while it was recorded. With a path it is there at all times."""
    hidden: tuple[tuple[float, float], ...] = ()
    """Normalized times from when to when it is not drawn."""

    def shows(self, time: float, recorded: bool) -> bool:
        """Whether it is drawn at a time at which it was recorded, or was not."""
        return (recorded or self.path is not None) and not any(start <= time < end for start, end in self.hidden)


class EditedNode(Node):
    """A node of objects of which some go other ways or are hidden; its Gaussians are those of the node."""

    def __init__(self, node: Tracked, changes: Mapping[int, Change]) -> None:
        """``changes``: instance of the node -> what becomes of it."""
        super().__init__(node.settings, node.rows, node.mask)
        self.node = node
        self.changes = dict(changes)

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        raw = self.node.raw_at(view, state)
        return replace(raw, placement=Placement(self.pose_at(view.time), self.node.rows.instances))

    def pose_at(self, time: float) -> Poses:
        """Pose and presence of every instance at a normalized time."""
        poses = self.node.pose_at(time)
        frames = self.node.object_frames(poses)
        present = poses.present.tolist()
        wanted = {}
        for instance, change in self.changes.items():
            present[instance] = change.shows(time, present[instance])
            if change.path is not None and present[instance]:
                wanted[instance] = change.path.frame(time, recorded_frames(self.node, instance))
        return replace(_transported(poses, frames, wanted), present=torch.tensor(present, device=poses.present.device))

    def displacements_over(self, span: float, view: View, raw: RawGaussians) -> Float[Tensor, "n 3"]:
        before, after = (self.pose_at(view.time + side * span / 2) for side in (-1, 1))
        return moved_by_boxes(raw.means, self.node.rows.instances, before, after)

    def instances(self) -> Instances:
        return self.node.instances()


class AddedObject(Node):
    """One object of a node, of this scene or of another, once more: at its own times on a way of its own."""

    chosen: Tensor

    def __init__(
        self,
        name: str,
        source: Tracked,
        instance: int,
        change: Change,
        recorded: Recorded,
        to_source: Callable[[float], float],
    ) -> None:
        """
        Args:
            name: of the object.
            source: the node that has the object.
            instance: its number there.
            change: its way, and when it is hidden.
            recorded: the frames that this way starts from, in the world of the scene that gets the object.
            to_source: normalized time of that scene -> that of the scene which has the object.
        """
        chosen, table = source.rows.instances == instance, source.rows
        own = {name: column.detach()[chosen] for name, column in table.columns().items() if name not in table.transient}
        super().__init__(source.settings, Rows.of(own))
        self.name, self.source, self.instance, self.change = name, source, instance, change
        self.recorded, self.to_source = recorded, to_source
        self.register_buffer("chosen", chosen, persistent=False)

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        raw = self.source.raw_at(replace(view, time=self._source_time(view.time)), state)
        chosen = self.chosen
        return RawGaussians(
            raw.means[chosen],
            raw.log_scales[chosen],
            raw.quaternions[chosen],
            raw.opacity_logits[chosen],
            raw.sh_dc[chosen],
            raw.sh_rest[chosen],
            None if raw.multipliers is None else raw.multipliers[chosen],
            Placement(self.pose_at(view.time), self._zeros()),
        )

    def pose_at(self, time: float) -> Poses:
        """Pose and presence of the object at a normalized time."""
        poses = self.source.pose_at(self._source_time(time))
        one = slice(self.instance, self.instance + 1)
        own = Poses(poses.quaternions[one], poses.translations[one], poses.present[one])
        frames = self.source.object_frames(poses)[one]
        moved = _transported(own, frames, {0: self._path.frame(time, self.recorded)})
        shown = torch.tensor([self.change.shows(time, recorded=True)], device=own.present.device)
        return replace(moved, present=shown)

    def displacements_over(self, span: float, view: View, raw: RawGaussians) -> Float[Tensor, "n 3"]:
        before, after = (self.pose_at(view.time + side * span / 2) for side in (-1, 1))
        return moved_by_boxes(raw.means, self._zeros(), before, after)

    def instances(self) -> Instances:
        one = slice(self.instance, self.instance + 1)
        return Instances((self.name,), self._zeros(), self.source.sizes[one], classes=self.source.classes[one])

    @property
    def _path(self) -> Path:
        assert self.change.path is not None, "an added object has a way"
        return self.change.path

    def _source_time(self, time: float) -> float:
        # Outside of its life nobody saw how it moves.
        start, end = self.source.spans[self.instance].tolist()
        return min(max(self.to_source(self._path.clock(time)), start), end)

    def _zeros(self) -> Int[Tensor, " n"]:
        return torch.zeros(len(self.rows), dtype=torch.int64, device=self.rows.means.device)


def recorded_frames(node: Tracked, instance: int) -> Recorded:
    """Where an object was at a time; before and after its life at its first and last place."""
    return lambda time: node.object_frames(node.pose_at(time))[instance]


def _transported(poses: Poses, frames: Float64[np.ndarray, "i 4 4"], wanted: Mapping[int, Frame]) -> Poses:
    """Poses of boxes, those of some objects carried along to where their frames are wanted."""
    if not wanted:
        return poses
    chosen = list(wanted)
    moves = torch.from_numpy(np.stack([wanted[index] @ np.linalg.inv(frames[index]) for index in chosen]))
    moves = moves.to(poses.translations.device)
    quaternions, translations = poses.quaternions.clone(), poses.translations.clone()
    old = translations[chosen].double()
    translations[chosen] = ((moves[:, :3, :3] @ old[:, :, None])[..., 0] + moves[:, :3, 3]).to(translations.dtype)
    turned = quat.multiply(quat.from_matrix(moves[:, :3, :3]), quaternions[chosen].double())
    quaternions[chosen] = turned.to(quaternions.dtype)
    return replace(poses, quaternions=quaternions, translations=translations)
