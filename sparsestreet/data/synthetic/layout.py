"""The cross-section of the street, meters in y (left is positive); the ego car drives at y = 0."""

EGO_LANE = 0.0
OVERTAKING_LANE = 3.5
ONCOMING_LANE = 7.0
CYCLE_LANE = -2.55
LANES = (-3.0, 8.6)
"""From the right side of the lanes to their left, between the parked cars."""
PARKING_RIGHT = -4.45
PARKING_LEFT = 10.0

CURB_RIGHT = -5.6
CURB_LEFT = 11.2
FOOTWAY_WIDTH = 3.6
CURB_HEIGHT = 0.13

SOLID_LINES = (-1.75, -3.35, 5.15, 5.40, 8.75)
DASHED_LINES = (1.75,)

BEHIND = 40.0
"""The street starts this many meters behind the first frame."""
AHEAD = 95.0
"""The street ends this many meters after the last frame."""
