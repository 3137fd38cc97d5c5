"""What the commands that open a trained scene have in common."""

from collections.abc import Sequence
from pathlib import Path

import torch

from sparsestreet.cli.checks import device_of
from sparsestreet.cli.targets import open_run_config
from sparsestreet.scene.beside import views_of
from sparsestreet.scene.storage import StoredScene, load_scene
from sparsestreet.scene.views import RecordedViews, read_views


def open_scene(path: Path, device: str | None = None, parts: Sequence[str] = ()) -> StoredScene:
    """The scene file, or that of a run's folder, on a device; None: a GPU if there is one.

    A scene file names classes, but imports nothing from outside this package: of a run's folder those are imported
    that lie in ``parts``, modules that the user's command trusts.

    Raises FileNotFoundError where there is none, ValueError for a device that is not there or a file that is no scene.
    """
    if (path / ".hydra").is_dir():
        open_run_config(path, parts)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    return load_scene(path, device_of(device, f"device={device}", "say device=cpu, or check the driver"))


def folder_of(scene: Path) -> Path:
    """The folder of a run that was given as it is, or by its scene file."""
    return scene if scene.is_dir() else scene.parent


def recorded_views(scene: Path, file: Path | None = None) -> RecordedViews:
    """The views of a file, or those of the scene. Raises FileNotFoundError or ValueError for none or damaged ones."""
    return views_of(scene) if file is None else read_views(file)
