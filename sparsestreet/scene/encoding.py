"""Converts settings to JSON and back: frozen dataclasses with the name of their class, and nothing executable.

A class is found by its module's name. The module must belong to this package or be imported already, so a file never
imports foreign code by itself.
"""

import importlib
import math
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

CLASS = "class"
"""Key of a JSON object that stands for a dataclass, or for a number that JSON does not know."""

_NUMBER = "float"

_Settings = TypeVar("_Settings")


def encode(value: Any) -> Any:
    """Returns plain values, lists, mappings and frozen dataclasses as strict JSON; floats keep every bit.

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
    """Returns what ``encode`` was given, tuples as lists. Raises ValueError for an unknown or unsuitable class.

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
    """Returns what ``encode`` was given. Raises TypeError if it is not a ``kind``."""
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
