"""A run's resolved configuration as a flat mapping: what identifies a run, and in which options runs differ.

Keys are dotted (``schedule.max_steps``), values are JSON scalars or lists.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase

Setting = bool | int | float | str | list | None
Configuration = Mapping[str, Setting]

IDENTITY_KEYS = (
    "seed",  # runs of other seeds are what repeats are
    "*.seed",  # interpolated from it: density control, the embedded street (whose name holds it)
    "name",
    "label",
    "resume",  # a resumed run is the run
    "out",
    "folder",
    "count_of",  # where a control has its numbers from; they are options of their own
    "data.root",  # where a log lies; the scene's name says which it is
    "data.log.root",
    "data.log.parent",
    "data.log.cache_mb",
    "image_points.cache",  # where points lie and who makes them, not which they are
    "image_points.threads",
    "split.val_frames",
    "callback.*.path",  # where something is written
    "logger",
    "logger.*",
    "trainer.accelerator",  # where a run was made is recorded beside it; how many devices share a step is a setting
    "trainer.log_every_n_steps",
    "trainer.val_check_interval",
    "trainer.limit_val_batches",
    "trainer.enable_*",
    "trainer.default_root_dir",
    "evaluation.*",
)
"""Patterns of the options that name a run, place it or watch it, and cannot change what it arrives at. All other
options are part of the configuration's identity."""


def flat_config(tree: Mapping[str, object], prefix: str = "") -> dict[str, Setting]:
    """A resolved tree of mappings as dotted key -> scalar or list; empty mappings vanish, infinities become words."""
    flat: dict[str, Setting] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat |= flat_config(value, f"{prefix}{key}.")
        elif isinstance(value, float) and not math.isfinite(value):
            flat[f"{prefix}{key}"] = str(value)
        else:
            flat[f"{prefix}{key}"] = list(value) if isinstance(value, tuple) else value
    return flat


def config_hash(config: Configuration) -> str:
    """12 hexadecimal digits of the SHA-256 of the configuration without ``IDENTITY_KEYS``: equal for repeats."""
    text = "\n".join(f"{key}={_canonical(value)}" for key, value in sorted(without(config, IDENTITY_KEYS).items()))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def without(config: Configuration, patterns: Iterable[str]) -> dict[str, Setting]:
    """The options whose keys match none of the patterns (``*`` stands for anything, dots too)."""
    patterns = tuple(patterns)
    return {key: value for key, value in config.items() if not any(fnmatchcase(key, one) for one in patterns)}


def only(config: Configuration, patterns: Iterable[str]) -> dict[str, Setting]:
    """The options whose keys match one of the patterns."""
    left = without(config, patterns)
    return {key: value for key, value in config.items() if key not in left}


def differing_options(configs: Sequence[Configuration], commands: Iterable[str] = ()) -> list[tuple[str, ...]]:
    """For each configuration the options in which it differs from any other, in words such as "split.stride=5".

    Options with the same values throughout are taken for interpolations of one: the one that a command gave, else the
    one with the shortest path. What some configurations lack altogether reads "with loss.depth", "without loss.depth".

    Args:
        configs: of the runs that one table compares.
        commands: that made them; options given there are always named.
    """
    given = given_keys(commands)
    words: list[tuple[str, ...]] = []
    named: set[tuple[str, ...]] = set()
    for key in sorted(set().union(*configs), key=lambda key: (key not in given, key.count("."), key)):
        part = _missing_part(key, configs)
        if part is None:
            values = tuple(_canonical(config.get(key)) for config in configs)
            option = tuple(f"{key}=" + value.strip('"') for value in values)
        else:
            values = option = tuple(("with " if _has(config, part) else "without ") + part for config in configs)
        if len(set(values)) > 1 and (values not in named or (part is None and key in given)):
            words.append(option)
        named.add(values)
    return [tuple(option[index] for option in words) for index in range(len(configs))]


def given_keys(commands: Iterable[str]) -> set[str]:
    """The keys of the options that stand in commands."""
    return {word.partition("=")[0].lstrip("+") for command in commands for word in command.split() if "=" in word}


def key_of(option: str) -> str:
    """The key of an option in the words of ``differing_options``."""
    return option.partition("=")[0].removeprefix("without ").removeprefix("with ")


def _missing_part(key: str, configs: Sequence[Configuration]) -> str | None:
    """The largest part of the tree around ``key`` that those which lack the key lack as a whole; None: just the key."""
    lacking = [config for config in configs if key not in config]
    names = key.split(".")
    for depth in range(1, len(names)):
        part = ".".join(names[:depth])
        if lacking and not any(_has(config, part) for config in lacking):
            return part
    return key if any(_has(config, key) for config in lacking) else None


def _has(config: Configuration, part: str) -> bool:
    return any(key.startswith(f"{part}.") for key in config)


def _canonical(value: Setting) -> str:
    """JSON in which 1 and 1.0, which YAML tells apart and nobody means to, are the same."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, list):
        return f"[{', '.join(map(_canonical, value))}]"
    return json.dumps(value, sort_keys=True)
