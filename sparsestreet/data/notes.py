"""What a run does without the parts that a log may lack."""

_ABSENT = {
    "sky": "no sky masks: nothing but the images tells sky from scene, and there is no sky term in the loss",
    "human": "no human masks: there are no metrics of human pixels",
    "vehicle": "no vehicle masks: there are no metrics of vehicle pixels",
    "lidar": "no lidar: Gaussians start from points in images and random ones, and there is no depth term in the loss",
    "boxes": "no boxes: nothing is modeled as moving, whatever moves becomes part of the background",
    "clock": "no clock: the frame rate is unknown, and a video plays at the one that log_fps says",
}


def counted(number: int, noun: str) -> str:
    """Return both, the noun in the plural unless there is one.

    >>> counted(1, "sweep"), counted(2, "sweep")
    ('1 sweep', '2 sweeps')
    """
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def absence_notes(*, sky: bool, human: bool, vehicle: bool, lidar: bool, boxes: bool, clock: bool) -> tuple[str, ...]:
    """A sentence for each part that a log does not have, of which a reader says for each whether it is there."""
    present = {"sky": sky, "human": human, "vehicle": vehicle, "lidar": lidar, "boxes": boxes, "clock": clock}
    return tuple(sentence for part, sentence in _ABSENT.items() if not present[part])
