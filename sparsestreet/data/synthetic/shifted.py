"""Views of a street from beside the recorded path: the truth of what a scene shows there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sparsestreet.data.images import read_image
from sparsestreet.data.lazy import Frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.transforms import inverse
from sparsestreet.types import Frame, View

_FRONT = 0


def shifted_frames(root: Path, log: DrivingLog) -> dict[float, Frames]:
    """Meters to the right -> the front views that ``novel_offsets`` (meters to the left) asked for, in order of time.

    They are in the log's world, and at its instants. A street that was made without has none.
    """
    recorded = {view.frame_index: view for view in log.views if view.camera_index == _FRONT}
    found = {-float(folder.name.removesuffix("m")): folder for folder in (root / "novel").glob("*m")}
    return {offset: _frames(found[offset], recorded, log) for offset in sorted(found)}


def _frames(folder: Path, recorded: dict[int, View], log: DrivingLog) -> Frames:
    files = {int(path.stem.partition("_")[0]): path for path in sorted((folder / "images").glob(f"*_{_FRONT}.png"))}
    views = [
        _view(recorded[frame], folder / "extrinsics" / f"{path.stem}.txt", log)
        for frame, path in files.items()
        if frame in recorded
    ]

    def load(view: View) -> Frame:
        size = (view.camera.width, view.camera.height)
        image = read_image(files[view.frame_index], size)
        return Frame(view.camera, view.time, view.frame_index, view.camera_index, image=image)

    return Frames(views, load)


def _view(recorded: View, extrinsics: Path, log: DrivingLog) -> View:
    pose = torch.from_numpy(np.loadtxt(extrinsics))
    world_from_camera = inverse(log.dataset_from_world) @ pose
    return replace(recorded, camera=replace(recorded.camera, camera_from_world=inverse(world_from_camera).float()))
