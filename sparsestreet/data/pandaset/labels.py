"""PandaSet's names of what is annotated, and which of them other data sets' classes get."""

from sparsestreet.data.roles import role_of

LABELS = frozenset(
    (
        "Car", "Pickup Truck", "Medium-sized Truck", "Semi-truck", "Towed Object", "Motorcycle",
        "Other Vehicle - Construction Vehicle", "Other Vehicle - Uncommon", "Other Vehicle - Pedicab",
        "Emergency Vehicle", "Bus", "Personal Mobility Device", "Motorized Scooter", "Bicycle", "Train", "Trolley",
        "Tram / Subway", "Pedestrian", "Pedestrian with Object", "Animals - Bird", "Animals - Other", "Pylons",
        "Road Barriers", "Signs", "Cones", "Construction Signs", "Temporary Construction Barriers",
        "Rolling Containers",
    )
)  # fmt: skip
_OF_ROLES = {"vehicle": "Car", "cyclist": "Bicycle", "pedestrian": "Pedestrian"}


def label(class_name: str) -> str:
    """PandaSet's label of a class of any data set; what is no road user that is known keeps its name.

    >>> label("vehicle.car"), label("Bus"), label("Misc")
    ('Car', 'Bus', 'Misc')
    """
    return class_name if class_name in LABELS else _OF_ROLES.get(role_of(class_name), class_name)
