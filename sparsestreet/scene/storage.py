"""The scene file: a trained scene that opens by itself, on any device, without the log it was made from.

Tensors in safetensors, and in its header, as JSON, what they mean: a version, the nodes and effects with their
settings, how the scene is rendered. No pickle, nothing of the log but the names of its tracks. Masks are not in it:
what they closed is gone.
"""

import copy
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from sparsestreet.atomic import atomic_file
from sparsestreet.scene.effects.effect import Effect, EffectSettings
from sparsestreet.scene.encoding import decode_as, encode
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import BakedMaskSettings
from sparsestreet.scene.nodes.node import Node, NodeSettings
from sparsestreet.scene.rendering import RenderOptions, SceneRendering, render
from sparsestreet.types import View

VERSION = 3
"""Raised when an older program could not read the file, or this one no older file."""

FILE_NAME = "scene.safetensors"
"""Name of the scene file in a run's folder."""

_KEY = "sparsestreet"
_ROWS = "rows."


@dataclass(frozen=True)
class StoredScene:
    """A trained scene, and how it is rendered."""

    scene: SceneGraph
    options: RenderOptions
    name: str
    """Of the log that it was trained on."""
    num_frames: int
    """Of that log: time 0 is its first frame, 1 its last."""

    @torch.no_grad()
    def render(self, view: View) -> SceneRendering:
        """The image of any view, without gradients."""
        return render(self.scene, view, options=self.options)


def save_scene(path: Path | str, stored: StoredScene) -> None:
    """Write the whole file or nothing. A scene with masks is written as they leave it, and stays as it is.

    Raises OSError where it cannot be written, TypeError for settings that are no plain values.
    """
    scene = _without_masks(stored.scene)
    header = {
        "version": VERSION,
        "name": stored.name,
        "num_frames": stored.num_frames,
        "options": encode(stored.options),
        "nodes": {
            name: {
                "settings": encode(node.settings),
                "header": node.header(),
                "columns": sorted(node.rows.columns()),
                "mask": None if node.mask is None else encode(node.mask.settings),
            }
            for name, node in scene.nodes.items()
        },
        "effects": {
            name: {"settings": encode(effect.settings), "header": effect.header()}
            for name, effect in scene.effects.items()
        },
    }
    # safetensors refuses what shares memory or is not contiguous.
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in scene.state_dict().items()}
    try:
        with atomic_file(Path(path)) as temporary:
            save_file(tensors, temporary, metadata={_KEY: json.dumps(header, allow_nan=False)})
    except SafetensorError as error:
        raise OSError(f"cannot write {path} ({error}): make room, or give another folder") from error


def load_scene(path: Path | str, device: torch.device | str = "cpu") -> StoredScene:
    """Open a scene file, or that of a run's folder; what it shows needs no log.

    Raises FileNotFoundError where there is none, ValueError for a file that is no scene or of another version.
    """
    path = Path(path)
    path = path / FILE_NAME if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"there is no scene at {path}: give a {FILE_NAME}, or the folder of a run that has one")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        if _KEY not in metadata:
            raise ValueError(f"the file holds tensors but no scene: give the {FILE_NAME} that a run wrote")
        stored = _scene_of(json.loads(metadata[_KEY]), tensors)
    except (SafetensorError, json.JSONDecodeError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        # Whatever else is wrong: the header does not say what the tensors are.
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{path} is no scene file or is damaged ({reason}): write it again") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    stored.scene.to(torch.device(device))
    return stored


def _scene_of(header: Mapping[str, Any], tensors: dict[str, Tensor]) -> StoredScene:
    if header["version"] > VERSION:
        raise ValueError(f"the file has version {header['version']}, this program reads {VERSION}: update it")
    if header["version"] < VERSION:
        raise ValueError(
            f"the file has version {header['version']}, this program reads {VERSION}: train the scene again, or open "
            "it with the version that wrote it"
        )
    nodes = {name: _restored(entry, _below(f"nodes.{name}.", tensors)) for name, entry in header["nodes"].items()}
    effects = {
        name: _restored_effect(entry, _below(f"effects.{name}.", tensors)) for name, entry in header["effects"].items()
    }
    scene = SceneGraph(nodes, effects)
    scene.load_state_dict(tensors)
    options = decode_as(RenderOptions, header["options"])
    return StoredScene(scene.eval(), options, header["name"], header["num_frames"])


def _restored(entry: Mapping[str, Any], tensors: dict[str, Tensor]) -> Node:
    columns = {name: tensors[_ROWS + name] for name in entry["columns"]}
    rows = Rows(
        {name: column for name, column in columns.items() if column.is_floating_point()},
        {name: column for name, column in columns.items() if not column.is_floating_point()},
    )
    node = decode_as(NodeSettings, entry["settings"]).restore(rows, tensors, entry["header"])
    if entry["mask"] is not None:
        node.mask = decode_as(BakedMaskSettings, entry["mask"]).restored(tensors["mask.times"])
    return node


def _restored_effect(entry: Mapping[str, Any], tensors: dict[str, Tensor]) -> Effect:
    settings = decode_as(EffectSettings, entry["settings"])
    found = settings.left_out() if settings.when == "off" else settings.restore(tensors, entry["header"])
    if found is None:
        raise ValueError(f"{type(settings).__name__} leaves nothing in its place where it is off: write the file again")
    return found


def _below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


@torch.no_grad()
def _without_masks(scene: SceneGraph) -> SceneGraph:
    """A copy in which the masks have done their work; the scene itself where it has none."""
    if not any(node.mask is not None and node.mask.columns for node in scene.nodes.values()):
        return scene
    scene = copy.deepcopy(scene)
    for node in scene.nodes.values():
        if node.mask is not None and node.mask.columns:
            node.rows.resize(node.mask.keep(node.rows).plan())
            node.finish_mask()
    return scene
