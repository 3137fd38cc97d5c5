"""What kind of road user a class name means, whichever data set it is from: writers map it to a name of their own."""

from collections.abc import Mapping
from typing import Literal

Role = Literal["vehicle", "cyclist", "pedestrian", "other"]

_NAMES: Mapping[Role, str] = {
    "vehicle": """vehicle car van truck bus tram train trolley caravan trailer motorcycle; unknown vehicle;
        vehicle.car; vehicle.truck; vehicle.bus.rigid; vehicle.bus.bendy; vehicle.trailer; vehicle.construction;
        vehicle.emergency.police; vehicle.emergency.ambulance; vehicle.motorcycle; regular_vehicle; large_vehicle;
        school_bus; articulated_bus; box_truck; truck_cab; vehicular_trailer; railed_vehicle; pickup truck;
        medium-sized truck; semi-truck; towed object; emergency vehicle; tram / subway;
        other vehicle - construction vehicle; other vehicle - uncommon""",
    "cyclist": "cyclist bicycle bicyclist motorcyclist rider; vehicle.bicycle; other vehicle - pedicab",
    "pedestrian": """pedestrian person; person (sitting); official_signaler; pedestrian with object;
        human.pedestrian.adult; human.pedestrian.child; human.pedestrian.construction_worker;
        human.pedestrian.police_officer""",
}
"""Lower case: single words up to the first semicolon, then one name between each two."""


def _table() -> dict[str, Role]:
    found: dict[str, Role] = {}
    for role, names in _NAMES.items():
        words, *others = names.split(";")
        found |= dict.fromkeys((*words.split(), *(" ".join(name.split()) for name in others)), role)
    return found


_ROLES = _table()


def role_of(class_name: str) -> Role:
    """``other`` for animals, strollers and whatever is not known.

    >>> role_of("REGULAR_VEHICLE"), role_of("human.pedestrian.adult"), role_of("Animals - Bird")
    ('vehicle', 'pedestrian', 'other')
    """
    return _ROLES.get(class_name.lower(), "other")
