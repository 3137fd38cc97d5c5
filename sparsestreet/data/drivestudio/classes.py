"""Names of classes that ``data=drivestudio`` knows, for those that only other readers know (conf/data)."""

_VEHICLES = (
    # Argoverse 2
    *("REGULAR_VEHICLE", "LARGE_VEHICLE", "BUS", "SCHOOL_BUS", "ARTICULATED_BUS", "BOX_TRUCK", "TRUCK", "TRUCK_CAB"),
    *("VEHICULAR_TRAILER", "RAILED_VEHICLE", "MOTORCYCLE"),
    # KITTI-360, rig.json
    *("car", "van", "truck", "bus", "tram", "caravan", "trailer", "train", "motorcycle", "vehicle", "unknown vehicle"),
    # PandaSet
    *("Pickup Truck", "Medium-sized Truck", "Semi-truck", "Towed Object", "Bus", "Emergency Vehicle", "Motorcycle"),
    *("Train", "Trolley", "Tram / Subway", "Other Vehicle - Construction Vehicle", "Other Vehicle - Uncommon"),
)
_CYCLISTS = (
    *("BICYCLE", "BICYCLIST", "MOTORCYCLIST"),
    *("rider", "bicycle", "cyclist"),
    *("Bicycle", "Other Vehicle - Pedicab"),
)
_PEDESTRIANS = ("PEDESTRIAN", "OFFICIAL_SIGNALER", "Pedestrian with Object", "Person (sitting)", "person", "pedestrian")
_MOBILITY = ("WHEELED_DEVICE", "WHEELED_RIDER", "Motorized Scooter", "Personal Mobility Device")
_ANIMALS = ("DOG", "ANIMAL", "Animals - Bird", "Animals - Other")

CLASS_NAMES = {
    **dict.fromkeys(_VEHICLES, "Vehicle"),
    **dict.fromkeys(_CYCLISTS, "Cyclist"),
    **dict.fromkeys(_PEDESTRIANS, "Pedestrian"),
    **dict.fromkeys(_MOBILITY, "human.pedestrian.personal_mobility"),
    **dict.fromkeys(_ANIMALS, "animal"),
    "STROLLER": "human.pedestrian.stroller",
    "WHEELCHAIR": "human.pedestrian.wheelchair",
}
"""All other names stay as they are."""
