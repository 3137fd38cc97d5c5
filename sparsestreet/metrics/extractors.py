"""Extractors: they turn an image into the features that distances between sets of images compare."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from sparsestreet.metrics.lpips import Lpips


@runtime_checkable
class Extractor(Protocol):
    """Computes the features of an image. ``name`` is that of the network; "inception" is reserved for that of FID."""

    @property
    def name(self) -> str: ...

    def __call__(self, image: Float[Tensor, "h w 3"]) -> Float[np.ndarray, " d"]:
        """Returns the features of an image in [0, 1]."""
        ...


@dataclass(frozen=True)
class LastLayer:
    """The last layer of an LPIPS network, averaged over the image."""

    name: str
    network: Lpips

    def __call__(self, image: Float[Tensor, "h w 3"]) -> Float[np.ndarray, " d"]:
        return self.network.features(image)[-1].double().mean((1, 2)).cpu().numpy()
