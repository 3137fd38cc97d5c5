"""nuScenes' names of what is annotated, and which of them other data sets' classes get."""

from sparsestreet.data.roles import role_of

CATEGORIES = frozenset(
    (
        "animal", "static_object.bicycle_rack", "human.pedestrian.adult", "human.pedestrian.child",
        "human.pedestrian.construction_worker", "human.pedestrian.personal_mobility",
        "human.pedestrian.police_officer", "human.pedestrian.stroller", "human.pedestrian.wheelchair",
        "movable_object.barrier", "movable_object.debris", "movable_object.pushable_pullable",
        "movable_object.trafficcone", "vehicle.bicycle", "vehicle.bus.bendy", "vehicle.bus.rigid", "vehicle.car",
        "vehicle.construction", "vehicle.emergency.ambulance", "vehicle.emergency.police", "vehicle.motorcycle",
        "vehicle.trailer", "vehicle.truck",
    )
)  # fmt: skip
_OF_ROLES = {"vehicle": "vehicle.car", "cyclist": "vehicle.bicycle", "pedestrian": "human.pedestrian.adult"}


def category(class_name: str) -> str:
    """nuScenes' category of a class of any data set; what is no road user that is known keeps its name.

    >>> category("Vehicle"), category("vehicle.truck"), category("Misc")
    ('vehicle.car', 'vehicle.truck', 'Misc')
    """
    return class_name if class_name in CATEGORIES else _OF_ROLES.get(role_of(class_name), class_name)
