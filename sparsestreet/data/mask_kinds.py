"""Which masks a log has, for layouts that have room for those of all images alone."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import torch

from sparsestreet.data.lazy import Frames, spread
from sparsestreet.types import Frame

KINDS = ("sky", "human", "vehicle")
_LOOKED_AT = 12
"""Images of a camera whose first one has no mask of the recording car."""


@dataclass(frozen=True)
class MaskKinds:
    """What was found in the images of a log."""

    everywhere: tuple[str, ...]
    """Those of KINDS that every image has."""
    lacking: Mapping[str, tuple[int, int]]
    """The other kinds, and frame and camera of the first image without."""
    ego: Mapping[int, Frame]
    """Camera -> a frame with the mask of the recording car that all of its images have."""
    changing_ego: tuple[int, ...]
    """Cameras whose images have different ones."""


@lru_cache(maxsize=1)
def find_masks(frames: Frames) -> MaskKinds:
    """Decodes images until no more kind can be in all of them: a few of a log without masks, else all."""
    lacking: dict[str, tuple[int, int]] = {}
    for frame in frames:
        for kind in KINDS:
            if kind not in lacking and getattr(frame, kind) is None:
                lacking[kind] = frame.indices
        if len(lacking) == len(KINDS):
            break
    ego, changing = {}, []
    for camera in sorted({view.indices[1] for view in frames.views}):
        own = frames.where(lambda view, camera=camera: view.camera_index == camera)
        first = own[0]
        others = own if first.ego is not None else own.at(spread(len(own), _LOOKED_AT))
        if not all(_same_ego(first, frame) for frame in others):
            changing.append(camera)
        elif first.ego is not None:
            ego[camera] = first
    everywhere = tuple(kind for kind in KINDS if kind not in lacking)
    return MaskKinds(everywhere, lacking, ego, tuple(changing))


def _same_ego(frame: Frame, other: Frame) -> bool:
    if frame.ego is None or other.ego is None:
        return frame.ego is other.ego
    return torch.equal(frame.ego, other.ego)
