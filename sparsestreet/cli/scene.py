"""What the commands that open a trained scene have in common."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import torch
from hydra.utils import get_object
from omegaconf import OmegaConf

from sparsestreet.cli.compose import load_run_config
from sparsestreet.cli.device import device_of
from sparsestreet.scene.beside import views_of
from sparsestreet.scene.storage import StoredScene, load_scene
from sparsestreet.scene.views import RecordedViews, read_views


def open_scene(path: Path, device: str | None = None) -> StoredScene:
    """The scene file, or that of a run's folder, on a device; None: a GPU if there is one.

    Raises FileNotFoundError where there is none, ValueError for a device that is not there or a file that is no scene.
    """
    if (path / ".hydra").is_dir():
        import_parts(path)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    return load_scene(path, device_of(device, f"device={device}", "say device=cpu, or check the driver"))


def folder_of(scene: Path) -> Path:
    """The folder of a run that was given as it is, or by its scene file."""
    return scene if scene.is_dir() else scene.parent


def recorded_views(scene: Path, file: Path | None = None) -> RecordedViews:
    """The views of a file, or those of the scene. Raises FileNotFoundError or ValueError for none or damaged ones."""
    return views_of(scene) if file is None else read_views(file)


def import_parts(run: Path) -> None:
    """Make the classes of a run's nodes and effects known, and of what is set within them (density, masks, sources).

    A scene file names them, but imports nothing from outside this package.
    """
    config = cast(dict[str, Any], OmegaConf.to_container(load_run_config(run)))
    for group in ("node", "effects"):
        for target in _targets(config.get(group)):
            if not target.startswith("sparsestreet."):
                get_object(target)


def _targets(tree: object) -> Iterator[str]:
    if isinstance(tree, dict):
        if "_target_" in tree:
            yield tree["_target_"]
        for value in tree.values():
            yield from _targets(value)
