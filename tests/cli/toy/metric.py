"""A number of one's own about a finished run."""

from pathlib import Path

from sparsestreet import load_scene
from sparsestreet.data.log import DrivingLog, split


def largest_errors(run: Path, log: DrivingLog) -> dict[tuple[int, int], float]:
    """(frame, camera) of each held-out view -> the largest error of a channel of a pixel, in [0, 1]."""
    stored = load_scene(run)
    errors = {}
    for frame in split(log, stride=10, offset=5).held_out:
        image = stored.render(frame).rgb.clamp(0, 1)
        errors[frame.frame_index, frame.camera_index] = float((image - frame.image / 255).abs().max())
    return errors
