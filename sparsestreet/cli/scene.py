"""What the commands that open a trained scene have in common."""

from pathlib import Path

import torch
from hydra.utils import get_class

from sparsestreet.cli.compose import load_run_config
from sparsestreet.cli.device import device_of
from sparsestreet.scene.storage import StoredScene, load_scene


def open_scene(path: Path, device: str | None = None) -> StoredScene:
    """The scene file, or that of a run's folder, on a device; None: a GPU if there is one.

    Raises FileNotFoundError where there is none, ValueError for a device that is not there or a file that is no scene.
    """
    if (path / ".hydra").is_dir():
        import_nodes(path)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    return load_scene(path, device_of(device, f"device={device}", "say device=cpu, or check the driver"))


def import_nodes(run: Path) -> None:
    """Make the run's node classes known: a scene file names them, but imports nothing from outside this package."""
    for node in load_run_config(run).node.values():
        if not node._target_.startswith("sparsestreet."):
            get_class(node._target_)
