"""What a scene shows beside the recorded path: how far that is from real images, and from the truth if it is known.

Distances of sets of images say little of few images, and something of the shift alone: compare scenes on equal views.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.device import to_device
from sparsestreet.data.lazy import Frames
from sparsestreet.data.log import Truth
from sparsestreet.evaluation.evaluate import screen_image
from sparsestreet.geometry.cameras import moved
from sparsestreet.metrics.definitions import metric_id
from sparsestreet.metrics.extractors import Extractor
from sparsestreet.metrics.lpips import Lpips
from sparsestreet.metrics.reported import PerceptualDistance, Psnr, SetDistances
from sparsestreet.records.novel import NovelRecord, NovelShift
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
    # One process measures: the others wait for nobody.
    distances = None if extractor is None else SetDistances(extractor, sync_on_compute=False)
    quality = Psnr(("full", "human", "vehicle"), sync_on_compute=False)
    perceptual = None if lpips is None else PerceptualDistance(lpips, sync_on_compute=False)
    metrics = [metric for metric in (quality, perceptual, distances) if metric is not None]
    if distances is not None:
        for frame in frames:
            distances.update(frame.image.to(device).float() / 255, real=True)

    def shift(offset: float) -> NovelShift:
        views = shifted_views(frames.views, offset, ramp)
        true_views, numbers = 0, {}
        for view in views:
            image = screen_image(scene, view, options)
            if distances is not None:
                distances.update(image, real=False)
            true = truth and truth(view)
            if true is not None:
                true_views += 1
                _compare(image, to_device(true, device), quality, perceptual)
        if true_views:
            numbers = {metric_id("psnr", region): value for region, value in quality.compute().items()}
            numbers |= {} if perceptual is None else {"lpips_alex": perceptual.compute()["full"]}
        found = NovelShift(
            offset=offset,
            views=len(views),
            distances={} if distances is None else distances.compute(),
            truth=numbers,
            true_views=true_views,
        )
        for metric in metrics:
            metric.reset()
        return found

    shifts = tuple(shift(sign * offset) for offset in offsets for sign in (1, -1))
    return NovelRecord(
        command=command,
        ramp=ramp,
        real_views=len(frames),
        absent=None if extractor is not None else absent,
        shifts=shifts,
    )


def _compare(image: Float[Tensor, "h w 3"], true: Frame, quality: Psnr, perceptual: PerceptualDistance | None) -> None:
    """Add a render and what would have been recorded to the means."""
    target = true.image.float() / 255
    quality.update(
        image, target, {name: mask for name in ("human", "vehicle") if (mask := getattr(true, name)) is not None}
    )
    if perceptual is not None:
        perceptual.update(image, target)


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
