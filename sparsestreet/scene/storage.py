"""The scene file: a trained scene that opens by itself, on any device, without the log it was made from.

Tensors in safetensors, and in its header, as JSON, what they mean: a version, the nodes and effects with their
settings, how the scene is rendered. No pickle, nothing of the log but the names of its tracks. Masks are not in it:
what they closed is gone.
"""

import json
from dataclasses import replace
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from sparsestreet.atomic import atomic_file
from sparsestreet.scene.stored import VERSION, StoredScene, description, scene_of, without_masks
from sparsestreet.scene.street_file import SUFFIX, read_street

__all__ = ["FILE_NAME", "SMALL_FILE_NAME", "VERSION", "StoredScene", "load_scene", "save_scene", "scene_path"]

FILE_NAME = "scene.safetensors"
"""Name of the scene file in a run's folder."""
SMALL_FILE_NAME = f"scene{SUFFIX}"
"""Name of what may stand in its place there."""

_KEY = "sparsestreet"


def save_scene(path: Path | str, stored: StoredScene) -> None:
    """Write the whole file or nothing. A scene with masks is written as they leave it, and stays as it is.

    Raises OSError where it cannot be written, TypeError for settings that are no plain values.
    """
    scene = without_masks(stored.scene)
    header = description(replace(stored, scene=scene))
    # safetensors refuses what shares memory or is not contiguous.
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in scene.state_dict().items()}
    try:
        with atomic_file(Path(path)) as temporary:
            save_file(tensors, temporary, metadata={_KEY: json.dumps(header, allow_nan=False)})
    except SafetensorError as error:
        raise OSError(f"cannot write {path} ({error}): make room, or give another folder") from error


def load_scene(path: Path | str, device: torch.device | str = "cpu") -> StoredScene:
    """Open a scene file, a .street, or that of a run's folder; what it shows needs no log.

    Raises FileNotFoundError where there is none, ValueError for a file that is no scene or of another version.
    """
    path = scene_path(Path(path))
    stored = read_street(path) if path.suffix == SUFFIX else _read_scene(path)
    stored.scene.to(torch.device(device))
    return stored


def scene_path(path: Path) -> Path:
    """The scene file that a path names; in a run's folder, a .street where there is no other.

    Raises FileNotFoundError where there is none.
    """
    whole, small = path / FILE_NAME, path / SMALL_FILE_NAME
    found = path if not path.is_dir() else small if small.is_file() and not whole.is_file() else whole
    if not found.is_file():
        raise FileNotFoundError(
            f"there is no scene at {found}: give a {FILE_NAME}, or the folder of a run that has one"
        )
    return found


def _read_scene(path: Path) -> StoredScene:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        if _KEY not in metadata:
            raise ValueError(f"the file holds tensors but no scene: give the {FILE_NAME} that a run wrote")
        return scene_of(json.loads(metadata[_KEY]), tensors)
    except (SafetensorError, json.JSONDecodeError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        # Whatever else is wrong: the header does not say what the tensors are.
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{path} is no scene file or is damaged ({reason}): write it again") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
