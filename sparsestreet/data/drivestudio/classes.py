"""Names of classes that DriveStudio's loaders know, and which of them a class of any data set gets.

A loader ends in a KeyError at every other name: its table OBJECT_CLASS_NODE_MAPPING, in
datasets/waymo/waymo_sourceloader.py and datasets/nuscenes/nuscenes_sourceloader.py, has these and no more.
"""

from collections.abc import Mapping

from sparsestreet.data.roles import role_of

RIGID, BODY, DEFORMABLE = "RigidNodes", "SMPLNodes", "DeformableNodes"
"""The nodes that DriveStudio models an object by."""

KNOWN: Mapping[str, Mapping[str, str]] = {
    "waymo": {"Vehicle": RIGID, "Pedestrian": BODY, "Cyclist": DEFORMABLE},
    "nuscenes": {
        **dict.fromkeys(("vehicle.bus.bendy", "vehicle.bus.rigid", "vehicle.car", "vehicle.construction"), RIGID),
        **dict.fromkeys(("vehicle.emergency.ambulance", "vehicle.emergency.police", "vehicle.motorcycle"), RIGID),
        **dict.fromkeys(("vehicle.trailer", "vehicle.truck"), RIGID),
        **dict.fromkeys(("human.pedestrian.adult", "human.pedestrian.child"), BODY),
        **dict.fromkeys(("human.pedestrian.construction_worker", "human.pedestrian.police_officer"), BODY),
        **dict.fromkeys(("human.pedestrian.personal_mobility", "human.pedestrian.stroller"), DEFORMABLE),
        **dict.fromkeys(("human.pedestrian.wheelchair", "animal", "vehicle.bicycle"), DEFORMABLE),
    },
}
"""Flavor -> name -> node."""

_OF_ROLES: Mapping[str, Mapping[str, str]] = {
    "waymo": {"vehicle": "Vehicle", "cyclist": "Cyclist", "pedestrian": "Pedestrian"},
    "nuscenes": {"vehicle": "vehicle.car", "cyclist": "vehicle.bicycle", "pedestrian": "human.pedestrian.adult"},
}
_MOBILITY = ("wheeled_device", "wheeled_rider", "motorized scooter", "personal mobility device", "misc", "other")
_OTHERS = {
    **dict.fromkeys(_MOBILITY, "human.pedestrian.personal_mobility"),
    **dict.fromkeys(("dog", "animal", "animals - bird", "animals - other"), "animal"),
    **{name: f"human.pedestrian.{name}" for name in ("stroller", "wheelchair")},
}
"""Lower case; road users of the role "other" that nuScenes has a name for, or, of Misc and other, one of their node."""


def class_in(flavor: str, class_name: str) -> str | None:
    """Return the name by which a flavor's loader models an object as its class asks; None: of no road user known.

    The loader of Waymo knows no animals, strollers and the like: they deform, as its cyclists do.

    >>> class_in("nuscenes", "BOX_TRUCK"), class_in("waymo", "vehicle.truck"), class_in("waymo", "STROLLER")
    ('vehicle.car', 'Vehicle', 'Cyclist')
    >>> class_in("nuscenes", "STOP_SIGN")
    """
    if class_name in KNOWN[flavor]:
        return class_name
    if (role := role_of(class_name)) != "other":
        return _OF_ROLES[flavor][role]
    other = class_name if class_name in KNOWN["nuscenes"] else _OTHERS.get(class_name.lower())
    return other if flavor == "nuscenes" or other is None else "Cyclist"
