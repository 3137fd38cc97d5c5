"""Loss terms; each is one file and knows only the rendering and the frame."""

from sparsestreet.training.losses.base import Loss
from sparsestreet.training.losses.depth import Depth
from sparsestreet.training.losses.dynamic_region import DynamicRegion
from sparsestreet.training.losses.inverse_depth_smoothness import InverseDepthSmoothness
from sparsestreet.training.losses.mask_sparsity import MaskSparsity
from sparsestreet.training.losses.opacity_entropy import OpacityEntropy
from sparsestreet.training.losses.photometric import Photometric
from sparsestreet.training.losses.sky import SkyMask

__all__ = [
    "Depth",
    "DynamicRegion",
    "InverseDepthSmoothness",
    "Loss",
    "MaskSparsity",
    "OpacityEntropy",
    "Photometric",
    "SkyMask",
]
