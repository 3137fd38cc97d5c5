"""What turns an image into the features by which sets of images are compared."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from sparsestreet.metrics.lpips import Lpips


@runtime_checkable
class Extractor(Protocol):
    """Features of an image; ``name`` says whose, and "inception" is for the network of FID alone."""

    @property
    def name(self) -> str: ...

    def __call__(self, image: Float[Tensor, "h w 3"]) -> Float[np.ndarray, " d"]:
        """Of an image in [0, 1]."""
        ...


@dataclass(frozen=True)
class LastLayer:
    """The last layer of a network of LPIPS, averaged over the image."""

    name: str
    network: Lpips

    def __call__(self, image: Float[Tensor, "h w 3"]) -> Float[np.ndarray, " d"]:
        return self.network.features(image)[-1].double().mean((1, 2)).cpu().numpy()
