"""What the sender of a request may not expect of its picture, said once in the server's log: guesses and refusals."""

import logging
import threading
from typing import Any

from sparsestreet.naming import FOUND, one_line
from sparsestreet.scene.edits import Edits, Given, objects_of
from sparsestreet.serving.renderer import ServedScene
from sparsestreet.types import View

log = logging.getLogger(__name__)

MAX_ELSEWHERE = 2.0
"""Meters from all recorded cameras; farther away, pictures hold what none of them saw."""
MAX_OFF = 0.5
"""Meters above or below the ground: twice what the ground's height is off (95 of 100 places)."""
HIDDEN = 20.0
"""Meters below the vehicle: an object that is put there is meant to be gone."""
MAX_REMARKS = 1000
"""Names of requests are anybody's: the log ends somewhere."""


class Remarks:
    """What was said already: of a scene's cameras, and of each object that requests name."""

    def __init__(self) -> None:
        self._said: set[tuple[str, ...]] = set()
        self._changing = threading.Lock()

    def on_names(self, served: ServedScene, request: Any) -> None:
        """Say which objects of a request the scene has not, which is an error, or which nobody annotated."""
        objects = objects_of(served.stored.scene)
        for name in (one.track_id for one in request.dynamic_objects):
            if name not in objects and self._is_first(served.name, "name", name):
                log.warning("%s: requests that name %s are refused: there is no such object", *_shown(served, name))
            elif name in objects and name.startswith(FOUND) and self._is_first(served.name, "name", name):
                said = "%s: %s was found in lidar, nobody annotated it: size and place of its box are guesses"
                log.warning(said, *_shown(served, name))

    def on_camera(self, served: ServedScene, view: View) -> None:
        """Say that a picture is from where no camera was."""
        meters = served.rig.distance(view)
        if meters > MAX_ELSEWHERE and self._is_first(served.name, "camera"):
            log.warning(
                "%s: a camera is %.1f m from where the log's were at that time; what none of them saw is a guess",
                served.name,
                meters,
            )

    def on_heights(self, served: ServedScene, time: float, edits: Edits) -> None:
        """Say which objects do not stand on the ground, at the first place of each."""
        objects, gone = objects_of(served.stored.scene), served.rig.at(time)[2, 3] - HIDDEN
        for name, change in edits.changes.items():
            assert isinstance(change.path, Given), "requests place objects"
            x, y, z = change.path.start[:3, 3].tolist()
            if z < gone or not self._is_first(served.name, "height", name):
                continue
            _, node, instance = objects[name]
            off = served.ground.off(x, y, z - node.frame_height(instance))
            if off is not None and abs(off) > MAX_OFF:
                side = "above" if off > 0 else "below"
                said = "%s: %s is %.1f m %s the ground: a pose is that of the middle of its box, in the scene's world"
                log.warning(said, *_shown(served, name), abs(off), side)

    def _is_first(self, *key: str) -> bool:
        with self._changing:
            first = key not in self._said and len(self._said) < MAX_REMARKS
            self._said |= {key} if first else set()
        return first


def _shown(served: ServedScene, name: str) -> tuple[str, str]:
    return one_line(served.name), one_line(name)
