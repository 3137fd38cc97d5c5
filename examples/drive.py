"""Drive through a trained street: steer the car, get the next pictures.

pip install 'sparsestreet[serve,video]'
python examples/drive.py outputs/RUN drive.mp4
"""

import sys
from pathlib import Path

import numpy as np

from sparsestreet import load_scene
from sparsestreet.export.video import side_by_side, write_pictures
from sparsestreet.scene.edits import Edits
from sparsestreet.serving.renderer import RigOptions, open_run, picture

STEP, WHEELBASE, AHEAD, BESIDE = 0.1, 2.8, 8.0, 0.5  # seconds, then meters; it keeps half a meter to the left


def steer(world_from_rig: np.ndarray, goal: np.ndarray) -> float:
    """Angle of the front wheels of a car that shall drive over a point (pure pursuit)."""
    x, y, _ = world_from_rig[:3, :3].T @ (goal - world_from_rig[:3, 3])
    return float(np.arctan(2 * WHEELBASE * y / (x * x + y * y)))


def step(world_from_rig: np.ndarray, speed: float, angle: float) -> np.ndarray:
    """Where the car is a step later (bicycle model)."""
    turn, way = STEP * speed / WHEELBASE * np.tan(angle), STEP * speed
    motion = np.eye(4)
    motion[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    motion[:2, 3] = way * np.cos(turn / 2), way * np.sin(turn / 2)
    return world_from_rig @ motion


def main(run: Path, out: Path) -> None:
    street = open_run(run, run.name, load_scene, RigOptions())
    rig, clock = street.rig, street.rig.clock
    path = np.stack([rig.at(time)[:3, 3] for time in np.linspace(0, 1, 500)])
    path += BESIDE * np.stack([rig.at(time)[:3, 1] for time in np.linspace(0, 1, 500)])
    speed = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) / clock.seconds
    car, pictures = rig.at(0.0), []
    for now in range(clock.start, clock.microseconds(1.0) + 1, round(1e6 * STEP)):
        views = [rig.view(camera.name, car, now) for camera in rig.cameras]
        pictures.append(side_by_side([picture(street, view, Edits()) for view in views]))
        far = np.flatnonzero(np.linalg.norm(path - car[:3, 3], axis=1) > AHEAD)
        ahead = [index for index in far if (path[index] - car[:3, 3]) @ car[:3, 0] > 0]
        car = step(car, speed, steer(car, path[ahead[0]]) if ahead else 0.0)
    write_pictures(out, pictures, fps=1 / STEP)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
