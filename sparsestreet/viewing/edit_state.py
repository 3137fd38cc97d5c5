"""What a user has done to the objects of a scene, as the values that a file of edits holds."""

import copy
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import yaml

from sparsestreet.scene.edits import edited, edits_of, objects_of
from sparsestreet.scene.edits.file import Open
from sparsestreet.scene.edits.nodes import recorded_frames
from sparsestreet.scene.edits.paths import Frame, placed
from sparsestreet.scene.graph import SceneGraph

_HEAD = "# Edits of a scene: sparsestreet render RUN drive.mp4 edits=FILE (docs/editing.md).\n"
_OFFSETS = ("forward", "right", "up", "turn")


@dataclass(frozen=True)
class Offset:
    """How an object is moved in its own frame, meters, and turned to the left, degrees."""

    forward: float = 0.0
    right: float = 0.0
    up: float = 0.0
    turn: float = 0.0

    @property
    def frame(self) -> Frame:
        """recorded_from_moved."""
        return placed(self.forward, -self.right, self.up, math.radians(self.turn))

    @staticmethod
    def of(frame: Frame) -> "Offset":
        """The inverse of ``frame``, of the turn about the object's z alone; millimeters and hundredths of a degree.

        >>> Offset.of(Offset(1.0, -2.0, 0.5, 30.0).frame)
        Offset(forward=1.0, right=-2.0, up=0.5, turn=30.0)
        """
        turn = math.degrees(math.atan2(frame[1, 0], frame[0, 0]))
        x, y, z = (round(float(value), 3) + 0.0 for value in frame[:3, 3])
        return Offset(x, -y + 0.0, z, round(turn, 2) + 0.0)


class EditState:
    """Objects hidden and moved, on top of a file of edits; all else that the file says stays."""

    def __init__(self, scene: SceneGraph, said: Mapping[str, Any], seconds: float, open_scene: Open) -> None:
        """
        Args:
            scene: as it was trained.
            said: the values of a file of edits; none: {}.
            seconds: of the scene's log.
            open_scene: opens scenes that the file names.

        Raises ValueError for values that are no edits of this scene.
        """
        self.recorded, self.seconds, self._open = scene, seconds, open_scene
        self._objects = objects_of(scene)
        self._rest = copy.deepcopy({key: value for key, value in said.items() if key not in ("remove", "hide", "move")})
        self._hidden = {str(name) for name in said.get("remove") or []}
        self._moves: dict[str, dict[str, Any]] = {str(n): {"hide": s} for n, s in (said.get("hide") or {}).items()}
        self._moves |= {str(name): dict(entry) for name, entry in (said.get("move") or {}).items()}
        edits_of(said, seconds, open_scene)
        self._scene = self._edited()

    @property
    def scene(self) -> SceneGraph:
        """The scene as it is edited now."""
        return self._scene

    @property
    def names(self) -> tuple[str, ...]:
        """Objects that can be hidden or moved: those of the scene that nothing replaces."""
        replaced = {str(name) for name in self._rest.get("replace") or {}}
        return tuple(name for name in self._objects if name not in replaced)

    def is_hidden(self, name: str) -> bool:
        return name in self._hidden

    def offset(self, name: str) -> Offset:
        entry = self._moves.get(name, {})
        return Offset(**{key: float(entry.get(key, 0.0)) for key in _OFFSETS})

    def goes_its_own_way(self, name: str) -> bool:
        """Whether the file holds it or gives it a path, which offsets exclude."""
        return bool({"hold", "path"} & self._moves.get(name, {}).keys())

    def hide(self, name: str, hidden: bool) -> None:
        """Hide an object, or show it again where it is moved to."""
        (self._hidden.add if hidden else self._hidden.discard)(name)
        self._scene = self._edited()

    def move(self, name: str, offset: Offset) -> None:
        """Move an object from where it was recorded. Raises ValueError for one that goes a way of its own."""
        if self.goes_its_own_way(name):
            raise ValueError(f"{name} has a hold: or path: in the file of edits, which no offset fits: edit it there")
        entry = {key: value for key, value in self._moves.get(name, {}).items() if key not in _OFFSETS}
        entry |= {key: value for key, value in asdict(offset).items() if value}
        self._moves[name] = entry
        if not entry.keys() - {"during"}:
            del self._moves[name]
        self._scene = self._edited()

    def frame(self, name: str, time: float) -> Frame:
        """world_from_object as it was recorded, at a normalized time."""
        _, node, instance = self._objects[name]
        return recorded_frames(node, instance)(time)

    def life(self, name: str) -> tuple[float, float]:
        """Seconds from when to when an object was recorded."""
        _, node, instance = self._objects[name]
        start, end = (float(value) * self.seconds for value in node.spans[instance])
        return start, end

    def class_name(self, name: str) -> str:
        _, node, instance = self._objects[name]
        return node.classes[instance]

    def said(self) -> dict[str, Any]:
        """The values of a file of edits that says the same."""
        moves = {name: entry for name, entry in self._moves.items() if name not in self._hidden}
        parts = {
            "remove": sorted(self._hidden),
            "hide": {name: entry["hide"] for name, entry in moves.items() if entry.keys() == {"hide"}},
            "move": {name: entry for name, entry in moves.items() if entry.keys() != {"hide"}},
        }
        return {key: value for key, value in parts.items() if value} | self._rest

    def text(self) -> str:
        """The file of edits."""
        return _HEAD + yaml.safe_dump(self.said(), sort_keys=False, allow_unicode=True, default_flow_style=None)

    def _edited(self) -> SceneGraph:
        return edited(self.recorded, edits_of(self.said(), self.seconds, self._open))


def own_frame(recorded: Frame, wanted: Frame) -> Frame:
    """recorded_from_wanted: what ``Offset.of`` takes for an object that was dragged to a place in the world."""
    return np.linalg.inv(recorded) @ wanted
