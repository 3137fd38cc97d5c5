"""What each effect brings: the same images rendered with and without it."""

from collections.abc import Sequence

import torch

from sparsestreet.data.lazy import Frames, spread
from sparsestreet.evaluation.evaluate import evaluate_frames
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.records.costs import EffectGain
from sparsestreet.records.summary import FrameQuality, summarize
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions

MOST_IMAGES = 60
"""Images that are rendered without each effect, spread over all."""


@torch.no_grad()
def measure_effect_gains(
    scene: SceneGraph,
    frames: Frames,
    quality: Sequence[FrameQuality],
    options: RenderOptions,
    ranks: Ranks = ALONE,
) -> dict[str, EffectGain]:
    """Name of each effect of the scene -> its gain on ``frames``, of which ``quality`` is that of the whole scene.

    ``ranks``: as in ``evaluate_frames``.
    """
    chosen = spread(len(frames), MOST_IMAGES)
    whole = _means([quality[index] for index in chosen])
    gains = {}
    for name in (name for name, effect in scene.effects.items() if effect.is_on):
        without = _means(list(evaluate_frames(scene.without(name), frames.at(chosen), options, ranks=ranks)))
        full, vehicle, human = (_less(*pair) for pair in zip(whole, without, strict=True))
        if full is not None:
            gains[name] = EffectGain(full, vehicle, human, len(chosen))
    return gains


def _means(quality: Sequence[FrameQuality]) -> list[float | None]:
    summary = summarize(quality)
    return [summary[metric].mean for metric in ("psnr_full", "psnr_vehicle", "psnr_human")]


def _less(whole: float | None, without: float | None) -> float | None:
    return None if whole is None or without is None else whole - without
