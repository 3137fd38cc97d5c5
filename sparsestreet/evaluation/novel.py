"""What a scene shows beside the recorded path: how far that is from real images, and from the truth if it is known.

Distances of sets of images say little of few images, and something of the shift alone: compare scenes on equal views.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
from jaxtyping import Float

from sparsestreet.data.lazy import Frames
from sparsestreet.evaluation.evaluate import evaluate_frames, screen_image
from sparsestreet.evaluation.strict_json import read_json, version, write_json
from sparsestreet.geometry.cameras import moved
from sparsestreet.metrics.distances import frechet_distance, frechet_name, kernel_distance, kernel_name
from sparsestreet.metrics.extractors import Extractor
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.types import View

FORMAT = 1
"""Version of ``novel.json``; raised when a key changes its meaning."""


@dataclass(frozen=True, kw_only=True)
class NovelShift:
    """One path beside the recorded one."""

    offset: float
    """Meters to the right of the rig, negative: to the left."""
    views: int
    """Number of its renders that are compared with the real images."""
    distances: dict[str, float]
    """Name of a distance, such as "frechet_alexnet" -> its value; empty where it could not be measured."""
    psnr: float | None
    """dB; mean over the true images at this offset. None: the log has none."""
    true_views: int
    """Number of true images."""


@dataclass(frozen=True, kw_only=True)
class NovelRecord:
    """The content of ``novel.json``."""

    format: int = version(FORMAT, "evaluate again with novel=...")
    command: str
    ramp: bool
    """Whether the shift grows from 0 at the first instant to its whole at the last, as in a change of lane."""
    real_views: int
    """Number of real images: of the recorded views that are shifted."""
    absent: str | None
    """Why there are no distances, and what to do about it; None: there are."""
    shifts: tuple[NovelShift, ...]

    def mean(self, meters: float, distance: str) -> float | None:
        """A distance at so many meters, mean over both sides; None where it was not measured."""
        values = [one.distances.get(distance) for one in self.shifts if abs(one.offset) == meters]
        found = [value for value in values if value is not None]
        return fmean(found) if found else None


def evaluate_novel(
    scene: SceneGraph,
    frames: Frames,
    offsets: Sequence[float],
    options: RenderOptions,
    *,
    command: str,
    truth: Mapping[float, Frames],
    extractor: Extractor | None,
    absent: str = "",
    ramp: bool = False,
) -> NovelRecord:
    """Shift recorded views by each offset to both sides, and compare.

    Args:
        scene: on the device where it renders.
        frames: recorded views, best those that training did not see; one image at a time is in memory.
        offsets: meters, above 0.
        options: how the scene is rendered.
        command: that asked for it.
        truth: meters to the right -> true images there; may be empty. They are compared at their own poses and
            instants, whatever ``ramp`` says.
        extractor: of the features that distances compare; None: no distances.
        absent: why there is no extractor.
        ramp: as in ``NovelRecord``.

    Raises ValueError without views, for offsets that are not above 0, or for renders that are not finite.
    """
    if not frames or not offsets or not min(offsets) > 0:
        raise ValueError(f"novel views need recorded ones and offsets above 0 m, got {len(frames)} and {list(offsets)}")
    if len(frames) < 2:
        extractor, absent = None, "distances need at least two images: hold out more views"
    device = scene.device
    real = extractor and _stacked(extractor(frame.image.to(device).float() / 255) for frame in frames)

    def shift(offset: float) -> NovelShift:
        views = shifted_views(frames.views, offset, ramp)
        distances = {}
        if extractor is not None:
            ours = _stacked(extractor(screen_image(scene, view, options)) for view in views)
            distances[frechet_name(extractor.name)] = frechet_distance(ours, real)
            distances[kernel_name(extractor.name)] = kernel_distance(ours, real)
        psnr = [one.value("psnr", "full") for one in evaluate_frames(scene, truth.get(offset, ()), options)]
        mean = fmean(psnr) if psnr else None
        return NovelShift(offset=offset, views=len(views), distances=distances, psnr=mean, true_views=len(psnr))

    shifts = tuple(shift(sign * offset) for offset in offsets for sign in (1, -1))
    return NovelRecord(
        command=command,
        ramp=ramp,
        real_views=len(frames),
        absent=None if extractor is not None else absent,
        shifts=shifts,
    )


def shifted_views(views: Sequence[View], offset: float, ramp: bool = False) -> list[View]:
    """Views moved sideways, all cameras of an instant as one, meters to the right of the camera of the lowest index.

    They keep time and camera, but lose their frame index: nobody recorded them.
    """
    instants = sorted({view.frame_index for view in views})
    steps = np.linspace(0, 1, len(instants)) if ramp and len(instants) > 1 else np.ones(len(instants))
    shares = dict(zip(instants, steps.tolist(), strict=True))
    fronts: dict[int, View] = {}
    for view in sorted(views, key=lambda view: view.camera_index):
        fronts.setdefault(view.frame_index, view)
    found = []
    for view in views:
        right = fronts[view.frame_index].camera.camera_from_world[0, :3].double()
        camera = moved(view.camera, shares[view.frame_index] * offset * right)
        found.append(replace(view, camera=camera, frame_index=None))
    return found


def novel_path(run: Path) -> Path:
    """Where a run keeps what was measured beside its path."""
    return run / "records" / "novel.json"


def write_novel(path: Path, record: NovelRecord) -> None:
    """Write ``novel.json`` atomically. Raises RecordError for values that JSON has no number for."""
    write_json(path, record)


def read_novel(path: Path) -> NovelRecord:
    """Read ``novel.json``. Raises RecordError naming the file and the entry that is wrong."""
    return read_json(path, NovelRecord)


def _stacked(features: Iterable[Float[np.ndarray, " d"]]) -> Float[np.ndarray, "n d"]:
    return np.stack(list(features))
