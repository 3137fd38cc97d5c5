"""What a scene shows beside the recorded path: how far that is from real images, and from the truth if it is known.

Distances of sets of images say little of few images, and something of the shift alone: compare scenes on equal views.
"""

from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.device import to_device
from sparsestreet.data.lazy import Frames
from sparsestreet.data.log import Truth
from sparsestreet.evaluation.evaluate import screen_image
from sparsestreet.geometry.cameras import moved
from sparsestreet.metrics.distances import frechet_distance, frechet_name, kernel_distance, kernel_name
from sparsestreet.metrics.extractors import Extractor
from sparsestreet.metrics.image import masked_psnr, psnr
from sparsestreet.metrics.lpips import Lpips
from sparsestreet.records.renders import NovelRecord, NovelShift
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.types import Frame, View


@torch.no_grad()
def evaluate_novel(
    scene: SceneGraph,
    frames: Frames,
    offsets: Sequence[float],
    options: RenderOptions,
    *,
    command: str,
    truth: Truth | None,
    extractor: Extractor | None,
    lpips: Lpips | None = None,
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
        truth: what a view would have recorded; None: nobody knows.
        extractor: of the features that distances compare; None: no distances.
        lpips: compares renders with true images; None: PSNR alone does.
        absent: why there is no extractor.
        ramp: as in ``NovelRecord``.

    Raises ValueError without views, for offsets that are not above 0, or for renders that are not finite.
    """
    if not frames or not offsets or not min(offsets) > 0:
        raise ValueError(f"novel views need recorded ones and offsets above 0 m, got {len(frames)} and {list(offsets)}")
    if len(frames) < 2:
        extractor, absent = None, "distances need at least two images: hold out more views"
    device = scene.device
    real = None if extractor is None else _features(extractor, frames, device)

    def shift(offset: float) -> NovelShift:
        views = shifted_views(frames.views, offset, ramp)
        features, quality = [], []
        for view in views:
            image = screen_image(scene, view, options)
            if extractor is not None:
                features.append(extractor(image))
            true = truth and truth(view)
            if true is not None:
                quality.append(_quality(image, to_device(true, device), lpips))
        return NovelShift(
            offset=offset,
            views=len(views),
            distances={} if extractor is None or real is None else _distances(extractor.name, np.stack(features), real),
            truth=_means(quality),
            true_views=len(quality),
        )

    shifts = tuple(shift(sign * offset) for offset in offsets for sign in (1, -1))
    return NovelRecord(
        command=command,
        ramp=ramp,
        real_views=len(frames),
        absent=None if extractor is not None else absent,
        shifts=shifts,
    )


def _features(extractor: Extractor, frames: Frames, device: torch.device) -> Float[np.ndarray, "n d"]:
    return np.stack([extractor(frame.image.to(device).float() / 255) for frame in frames])


def _distances(extractor: str, ours: Float[np.ndarray, "n d"], real: Float[np.ndarray, "m d"]) -> dict[str, float]:
    return {
        frechet_name(extractor): frechet_distance(ours, real),
        kernel_name(extractor): kernel_distance(ours, real),
    }


def _quality(image: Float[Tensor, "h w 3"], true: Frame, lpips: Lpips | None) -> dict[str, float]:
    """PSNR of the whole image, and of the regions that it has; LPIPS of the whole."""
    target = true.image.float() / 255
    whole = {"psnr_full": psnr(image, target)} | ({} if lpips is None else {"lpips_alex": lpips(image, target)})
    regions = {"psnr_human": true.human, "psnr_vehicle": true.vehicle}
    found = {name: masked_psnr(image, target, mask) for name, mask in regions.items() if mask is not None}
    return whole | {name: value for name, value in found.items() if value is not None}


def _means(quality: Sequence[dict[str, float]]) -> dict[str, float]:
    """Of each number over the images that have it."""
    names = dict.fromkeys(name for one in quality for name in one)
    return {name: fmean(one[name] for one in quality if name in one) for name in names}


def shifted_views(views: Sequence[View], offset: float, ramp: bool = False) -> list[View]:
    """Views moved sideways, all cameras of an instant as one, meters to the right of the camera of the lowest index.

    They keep time and camera, but lose their frame index: nobody recorded them.
    """
    instants = sorted({view.indices[0] for view in views})
    steps = np.linspace(0, 1, len(instants)) if ramp and len(instants) > 1 else np.ones(len(instants))
    shares = dict(zip(instants, steps.tolist(), strict=True))
    fronts: dict[int, View] = {}
    for view in sorted(views, key=lambda view: view.indices[1]):
        fronts.setdefault(view.indices[0], view)
    found = []
    for view in views:
        instant, _ = view.indices
        right = fronts[instant].camera.camera_from_world[0, :3].double()
        camera = moved(view.camera, shares[instant] * offset * right)
        found.append(replace(view, camera=camera, frame_index=None))
    return found
