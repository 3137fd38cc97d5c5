"""Converts settings to JSON and back: frozen dataclasses with the name of their class, and nothing executable.

A class is found by its module's name. The module must belong to this package or be imported already, so a file never
imports foreign code by itself.
"""

import copy
import importlib
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from sparsestreet.finite import check_finite
from sparsestreet.scene.effects.effect import Effect, EffectSettings
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import BakedMaskSettings
from sparsestreet.scene.nodes.node import Node, NodeSettings
from sparsestreet.scene.rendering import RenderOptions, SceneRendering, render
from sparsestreet.scene.standing import StandingScene
from sparsestreet.types import View

CLASS = "class"
"""Key of a JSON object that stands for a dataclass, or for a number that JSON does not know."""

_NUMBER = "float"

_Settings = TypeVar("_Settings")


def encode(value: Any) -> Any:
    """Return plain values, lists, mappings and frozen dataclasses as strict JSON; floats keep every bit.

    Raises TypeError, naming the type, for anything else, ValueError for a mapping with the key ``class``.

    >>> encode({"width": 64, "limit": float("inf")})
    {'width': 64, 'limit': {'class': 'float', 'value': 'inf'}}
    """
    if is_dataclass(value) and not isinstance(value, type):
        entries = {field.name: encode(getattr(value, field.name)) for field in fields(value)}
        return {CLASS: f"{type(value).__module__}:{type(value).__qualname__}", **entries}
    if isinstance(value, Mapping):
        if CLASS in value:
            raise ValueError(f"{CLASS!r} marks a dataclass and is no key of a mapping, got {dict(value)}: rename it")
        return {str(key): encode(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [encode(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return {CLASS: _NUMBER, "value": str(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"settings hold plain values, lists, mappings and dataclasses, got a {type(value).__name__}")


def decode(value: Any) -> Any:
    """Return what ``encode`` was given, tuples as lists. Raises ValueError for an unknown or unsuitable class.

    >>> from sparsestreet.scene.learning_rate import LearningRate
    >>> decode(encode(LearningRate(0.01))) == LearningRate(0.01)
    True
    """
    if isinstance(value, list):
        return [decode(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    entries = {key: decode(entry) for key, entry in value.items() if key != CLASS}
    if CLASS not in value:
        return entries
    if value[CLASS] == _NUMBER:
        return float(entries["value"])
    kind = _find(value[CLASS])
    try:
        return kind(**entries)
    except TypeError as error:
        raise ValueError(f"{value[CLASS]} of this version cannot be made from the file ({error})") from error


def decode_as(kind: type[_Settings], value: Any) -> _Settings:
    """Return what ``encode`` was given. Raises TypeError if it is not a ``kind``."""
    decoded = decode(value)
    if not isinstance(decoded, kind):
        raise TypeError(f"a {type(decoded).__name__} stands where a {kind.__name__} belongs")
    return decoded


def _find(name: str) -> type:
    module_name, _, qualified = name.partition(":")
    if not module_name.startswith("sparsestreet.") and module_name not in sys.modules:
        raise ValueError(f"the file uses {name!r}, which this program has not imported: import {module_name} first")
    try:
        found: Any = importlib.import_module(module_name)
        for part in qualified.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"the file uses {name!r}, which this version does not have: load it with its own") from error
    if not (isinstance(found, type) and is_dataclass(found)):
        raise ValueError(f"the file uses {name!r} as settings, but that is no dataclass: the file is damaged")
    return found


VERSION = 3
"""Raised when an older program could not read the description, or this one no older description."""

ROWS = "rows."
"""Begins the names of a node's tensors that are columns."""

DAMAGED = "the scene is damaged, train it again"
"""What is to be done where a number of a scene is none."""

_HIGHER_HARMONICS = [(terms - 1, 3) for terms in (1, 4, 9, 16)]


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

    def standing(self) -> "StoredScene":
        """The same for many frames: what stands still is activated once (``scene.standing.StandingScene``)."""
        return replace(self, scene=StandingScene.of(self.scene))


def description(stored: StoredScene) -> dict[str, Any]:
    """What the tensors of a scene mean, for JSON. Raises TypeError for settings that are no plain values."""
    scene = stored.scene
    return {
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


def scene_of(header: Mapping[str, Any], tensors: dict[str, Tensor]) -> StoredScene:
    """The scene that was described, from all its tensors by name. Raises ValueError for another version, and what not
    else for a description that does not say what the tensors are.
    """
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


def check_numbers(scene: SceneGraph) -> None:
    """Raise ValueError where a number of a scene is NaN or infinite; it names node and field, row and value."""
    tensors = {name: value.detach() for name, value in scene.state_dict().items() if value.is_floating_point()}
    check_finite({name: value if value.dim() else value[None] for name, value in tensors.items()}, DAMAGED)


def _restored(entry: Mapping[str, Any], tensors: dict[str, Tensor]) -> Node:
    rows = Rows.of({name: tensors[ROWS + name] for name in entry["columns"]})
    terms = tuple(rows.sh_rest.shape[1:])
    if terms not in _HIGHER_HARMONICS:  # others would pass for columns, of which tables of squared size are made
        raise ValueError(f"a row has 0, 3, 8 or 15 x 3 harmonics above the first, got {terms}: write the file again")
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
def without_masks(scene: SceneGraph) -> SceneGraph:
    """A copy in which the masks have done their work; the scene itself where it has none."""
    if not any(node.mask is not None and node.mask.columns for node in scene.nodes.values()):
        return scene
    scene = copy.deepcopy(scene)
    for node in scene.nodes.values():
        if node.mask is not None and node.mask.columns:
            node.rows.resize(node.mask.keep(node.rows).plan())
            node.finish_mask()
    return scene
