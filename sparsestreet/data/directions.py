"""Names of cameras in layouts that call them by where they look."""

import math
from collections.abc import Mapping

from sparsestreet.data.placed import PlacedLog


def names_by_direction(placed: PlacedLog, names: Mapping[str, float], other: str) -> dict[int, str]:
    """Index of a camera -> its name: the log's own where a layout has all of them, else by the direction.

    Cameras choose in the order of the log, each the free name whose direction is nearest, and the first one is ahead.

    Args:
        placed: the log.
        names: of the layout, with the directions: degrees to the left of the first.
        other: begins the names of cameras for which none is left.
    """
    log = placed.log
    first = {view.indices[1]: view for view in reversed(log.views)}
    own = dict(enumerate(log.camera_names))
    if all(own.get(index) in names for index in first):
        return {index: own[index] for index in sorted(first)}
    poses = {index: placed.world_from_camera(view) for index, view in sorted(first.items())}
    ahead = poses[log.views[0].indices[1]][:3, :3]
    found: dict[int, str] = {}
    for index, pose in poses.items():
        right, _, forward = (ahead.T @ pose[:3, 2]).tolist()
        yaw = math.degrees(math.atan2(-right, forward))
        free = {
            name: abs((yaw - angle + 180) % 360 - 180) for name, angle in names.items() if name not in found.values()
        }
        found[index] = min(free, key=lambda name: free[name]) if free else f"{other}{index}"
    return found


def name_losses(placed: PlacedLog, found: Mapping[int, str]) -> list[str]:
    """A sentence of the cameras that a layout calls otherwise than the log; none where it has no other names."""
    own = dict(enumerate(placed.log.camera_names))
    other = [f"{own.get(index, index)} is {name}" for index, name in found.items() if own.get(index) != name]
    return [f"{len(other)} cameras get names of the layout: {', '.join(other)}"] if other else []


def ego_losses(placed: PlacedLog, found: Mapping[int, str], rows: Mapping[str, object]) -> list[str]:
    """A sentence of the cameras whose lowest ``rows`` readers take for the recording car, although it was another."""
    own = dict(enumerate(placed.log.camera_names))
    names = [name for index, name in found.items() if name in rows and own.get(index) != name]
    return [f"readers take the lowest rows of {', '.join(names)} for the recording car's"] if names else []
