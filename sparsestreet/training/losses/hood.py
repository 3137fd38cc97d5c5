"""The recording car in its own images: no loss shall teach it to the scene."""

from dataclasses import replace

import torch

from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


def without_hood(rendering: SceneRendering, frame: Frame) -> tuple[SceneRendering, Frame]:
    """Returns both as losses see them: on the pixels of ``ego`` black, without alpha, and without depth.

    There both images agree, alpha is that of a sky, and nothing has a gradient. Means stay those over all pixels, as in
    DriveStudio. A frame without such a mask and its rendering are returned as they are.
    """
    hood = frame.ego
    if hood is None:
        return rendering, frame
    seen = replace(
        rendering,
        rgb=torch.where(hood[..., None], 0.0, rendering.rgb),
        alpha=torch.where(hood, 0.0, rendering.alpha),
        depth=torch.where(hood, 0.0, rendering.depth),
    )
    recorded = replace(
        frame,
        image=frame.image.masked_fill(hood[..., None], 0),
        sky=None if frame.sky is None else frame.sky | hood,
        depth=None if frame.depth is None else frame.depth.masked_fill(hood, 0.0),
    )
    return seen, recorded
