"""The features of FID: 2,048 numbers of an image by the Inception-v3 that FID is published with (Heusel et al. 2017).

The network is that of Szegedy et al. 2015 in the variant of its first weights: averages do not count the padding, the
last block takes maxima where others average, and there are 1,008 classes. FID of other weights is another number.
"""

import os
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from sparsestreet.atomic import check_regular
from sparsestreet.metrics.distances import INCEPTION, distance_names
from sparsestreet.metrics.image import rounded
from sparsestreet.metrics.lpips import full_precision

SIDE = 299
"""Pixels to which height and width of every image are brought."""
NUM_FEATURES = 2048
NUM_CLASSES = 1008
_EPSILON = 1e-3
"""Added to the variance of a channel."""


@dataclass(frozen=True)
class Layer:
    """A convolution, the normalization of its channels and a rectifier, under a name of the file."""

    name: str
    channels: int
    kernel: tuple[int, int] = (1, 1)
    stride: int = 1
    padded: bool = True
    """Whether the image is padded such that stride 1 keeps its size."""


Branch = tuple[Layer | tuple[Layer, ...], ...]
"""Layers in turn; layers in a tuple have one input, and their outputs are joined. Empty: maxima with stride 2."""
POOLED = "branch_pool"
"""Name of the layer before which the input is pooled."""


def _separable(name: str, count: int, width: int, channels: int, *, tall_first: bool) -> tuple[Layer, ...]:
    """Return layers NAME_2, NAME_3, ... of 1x7 and 7x1 in turn, all of one width but the last."""
    kernels = [(7, 1) if tall_first == (index % 2 == 0) else (1, 7) for index in range(count)]
    widths = [width] * (count - 1) + [channels]
    return tuple(Layer(f"{name}_{index}", *how) for index, how in enumerate(zip(widths, kernels, strict=True), start=2))


def _mixed5(pooled: int) -> tuple[Branch, ...]:
    return (
        (Layer("branch1x1", 64),),
        (Layer("branch5x5_1", 48), Layer("branch5x5_2", 64, (5, 5))),
        (
            Layer("branch3x3dbl_1", 64),
            Layer("branch3x3dbl_2", 96, (3, 3)),
            Layer("branch3x3dbl_3", 96, (3, 3)),
        ),
        (Layer(POOLED, pooled),),
    )


_MIXED_6A: tuple[Branch, ...] = (
    (Layer("branch3x3", 384, (3, 3), 2, False),),
    (
        Layer("branch3x3dbl_1", 64),
        Layer("branch3x3dbl_2", 96, (3, 3)),
        Layer("branch3x3dbl_3", 96, (3, 3), 2, False),
    ),
    (),
)


def _mixed6(width: int) -> tuple[Branch, ...]:
    return (
        (Layer("branch1x1", 192),),
        (Layer("branch7x7_1", width), *_separable("branch7x7", 2, width, 192, tall_first=False)),
        (Layer("branch7x7dbl_1", width), *_separable("branch7x7dbl", 4, width, 192, tall_first=True)),
        (Layer(POOLED, 192),),
    )


_MIXED_7A: tuple[Branch, ...] = (
    (Layer("branch3x3_1", 192), Layer("branch3x3_2", 320, (3, 3), 2, False)),
    (
        Layer("branch7x7x3_1", 192),
        *_separable("branch7x7x3", 2, 192, 192, tall_first=False),
        Layer("branch7x7x3_4", 192, (3, 3), 2, False),
    ),
    (),
)
_MIXED_7: tuple[Branch, ...] = (
    (Layer("branch1x1", 320),),
    (Layer("branch3x3_1", 384), (Layer("branch3x3_2a", 384, (1, 3)), Layer("branch3x3_2b", 384, (3, 1)))),
    (
        Layer("branch3x3dbl_1", 448),
        Layer("branch3x3dbl_2", 384, (3, 3)),
        (Layer("branch3x3dbl_3a", 384, (1, 3)), Layer("branch3x3dbl_3b", 384, (3, 1))),
    ),
    (Layer(POOLED, 192),),
)


class Convolution(nn.Module):
    """A ``Layer`` with its weights, which the file calls conv and bn."""

    def __init__(self, inputs: int, layer: Layer) -> None:
        super().__init__()
        padding = (layer.kernel[0] // 2, layer.kernel[1] // 2) if layer.padded else 0
        self.conv = nn.Conv2d(inputs, layer.channels, layer.kernel, layer.stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(layer.channels, eps=_EPSILON)

    def forward(self, values: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o _ _"]:
        return self.bn(self.conv(values)).relu()


class Mixed(nn.Module):
    """Branches of layers over one input, joined."""

    def __init__(self, inputs: int, branches: Sequence[Branch], pool: Literal["average", "maximum"]) -> None:
        super().__init__()
        self.branches, self.pool, self.channels = tuple(branches), pool, 0
        for branch in branches:
            width = inputs
            for step in branch:
                layers = step if isinstance(step, tuple) else (step,)
                for layer in layers:
                    self.add_module(layer.name, Convolution(width, layer))
                width = sum(layer.channels for layer in layers)
            self.channels += width

    def forward(self, values: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o _ _"]:
        return torch.cat([self._branch(values, branch) for branch in self.branches], 1)

    def _branch(self, values: Float[Tensor, "n i h w"], branch: Branch) -> Float[Tensor, "n o _ _"]:
        if not branch:
            return functional.max_pool2d(values, 3, stride=2)
        if isinstance(branch[0], Layer) and branch[0].name == POOLED:
            values = self._pooled(values)
        for step in branch:
            layers = step if isinstance(step, tuple) else (step,)
            values = torch.cat([self.get_submodule(layer.name)(values) for layer in layers], 1)
        return values

    def _pooled(self, values: Float[Tensor, "n i h w"]) -> Float[Tensor, "n i h w"]:
        if self.pool == "maximum":
            return functional.max_pool2d(values, 3, stride=1, padding=1)
        return functional.avg_pool2d(values, 3, stride=1, padding=1, count_include_pad=False)


class InceptionV3(nn.Module):
    """The network up to its last pool, under the names of the file; its classes are read and not used."""

    def __init__(self) -> None:
        super().__init__()
        stem = {
            "Conv2d_1a_3x3": Layer("", 32, (3, 3), 2, False),
            "Conv2d_2a_3x3": Layer("", 32, (3, 3), 1, False),
            "Conv2d_2b_3x3": Layer("", 64, (3, 3)),
            "maxpool1": None,
            "Conv2d_3b_1x1": Layer("", 80),
            "Conv2d_4a_3x3": Layer("", 192, (3, 3), 1, False),
            "maxpool2": None,
        }
        blocks = {
            **{f"Mixed_5{letter}": _mixed5(pooled) for letter, pooled in zip("bcd", (32, 64, 64), strict=True)},
            "Mixed_6a": _MIXED_6A,
            **{f"Mixed_6{letter}": _mixed6(width) for letter, width in zip("bcde", (128, 160, 160, 192), strict=True)},
            "Mixed_7a": _MIXED_7A,
            "Mixed_7b": _MIXED_7,
            "Mixed_7c": _MIXED_7,
        }
        channels = 3
        for name, layer in stem.items():
            self.add_module(name, nn.MaxPool2d(3, 2) if layer is None else Convolution(channels, layer))
            channels = channels if layer is None else layer.channels
        for name, branches in blocks.items():
            block = Mixed(channels, branches, "maximum" if name == "Mixed_7c" else "average")
            self.add_module(name, block)
            channels = block.channels
        self.steps = (*stem, *blocks)
        self.fc = nn.Linear(NUM_FEATURES, NUM_CLASSES)

    def forward(self, values: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n f"]:
        """Return features of values in [-1, 1], averaged over places."""
        for name in self.steps:
            values = self.get_submodule(name)(values)
        return values.mean((2, 3))


class InceptionFeatures:
    """The extractor of FID (``distances.Extractor``); float32, on the device of its network.

    An image is rounded to 8 bits, as a file would have it, and brought to 299x299 pixels bilinearly.
    """

    name = INCEPTION

    def __init__(self, network: InceptionV3) -> None:
        self.network = network.eval().requires_grad_(False)

    @torch.no_grad()
    def __call__(self, image: Float[Tensor, "h w 3"]) -> Float[np.ndarray, " f"]:
        """Return the features of an image in [0, 1]."""
        values = rounded(image).permute(2, 0, 1)[None].float()
        resized = functional.interpolate(values, size=(SIDE, SIDE), mode="bilinear", align_corners=False)
        with full_precision(image.device):
            return self.network(2 * resized - 1)[0].double().cpu().numpy()


FOLDER_VARIABLE = "SPARSESTREET_FID"
"""Environment variable that names the folder with the file."""
WEIGHTS = "pt_inception-2015-12-05-6726825d.pth"
"""The file of pytorch-fid, by which FID is mostly computed in torch."""
REMEDY = f"set {FOLDER_VARIABLE} to a folder with {WEIGHTS}, the weights that pytorch-fid publishes (fid_weights)"


def open_inception(device: torch.device) -> tuple[InceptionFeatures | None, dict[str, str]]:
    """Return the extractor of FID, or None and for each distance of its features the reason with the remedy.

    Raises ValueError, naming the file, for damaged weights.

    >>> from unittest.mock import patch
    >>> with patch.dict(os.environ, {FOLDER_VARIABLE: "/absent"}):
    ...     found, missing = open_inception(torch.device("cpu"))
    >>> found, list(missing)
    (None, ['fid', 'kid'])
    """
    named = os.environ.get(FOLDER_VARIABLE)
    path = Path(named).expanduser() / WEIGHTS if named else None
    if path is None or not path.is_file():
        reason = f"no weights ({WEIGHTS}): {REMEDY}; then evaluate again"
        return None, dict.fromkeys(distance_names(INCEPTION), reason)
    return InceptionFeatures(read_inception(path).to(device)), {}


def read_inception(path: Path) -> InceptionV3:
    """Read the network from a file of pytorch-fid; nothing in the file is run.

    Raises FileNotFoundError, or ValueError, naming the file and what differs, if it is damaged or of another network.

    >>> read_inception(Path("/nowhere/weights.pth"))
    Traceback (most recent call last):
    FileNotFoundError: [Errno 2] No such file or directory: '/nowhere/weights.pth'
    """
    check_regular(path)
    network = InceptionV3()
    try:
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except (RuntimeError, TypeError, ValueError, AttributeError, EOFError, KeyError, pickle.UnpicklingError) as error:
        what = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        raise ValueError(f"{path} does not hold the Inception of FID ({what}): {REMEDY}") from error
    return network
