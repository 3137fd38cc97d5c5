"""A run's resolved configuration as a flat mapping. It identifies the run and shows in which options runs differ.

Keys are dotted (``schedule.max_steps``), values are JSON scalars or lists.
"""

import hashlib
import json
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

Setting = bool | int | float | str | list | None
Configuration = Mapping[str, Setting]

IDENTITY_KEYS = (
    "seed",  # runs of other seeds are what repeats are
    "*.seed",  # interpolated from seed: density control, the embedded street (whose name holds the seed)
    "name",
    "label",
    "resume",  # a resumed run is the same run
    "overwrite",
    "trunk",  # the run whose first steps this one takes; they are its own as well
    "checkpoint_every",
    "branch_points",
    "keep_checkpoints",
    "out",
    "folder",
    "capacity.*",  # its numbers are compared where they act
    "count_of",  # the run whose counts a control copies; the counts are options of their own
    "data.root",  # where a log lies; the scene's name identifies it
    "data.log.root",
    "data.log.parent",
    "data.log.cache_mb",
    "cache",  # where answers lie, and how many threads make points: they are the same
    "image_points.threads",
    "split.val_frames",
    "callback.*.path",  # where something is written
    "logger",
    "logger.*",
    "trainer.accelerator",  # the device is recorded separately; the number of devices that share a step is a setting
    "trainer.log_every_n_steps",
    "trainer.val_check_interval",
    "trainer.limit_val_batches",
    "trainer.enable_*",
    "trainer.default_root_dir",
    "evaluation.*",
)
"""Patterns of the options that name, place or watch a run and cannot change its result. All other options are part of
the configuration's identity."""


def flat_config(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Setting]:
    """Return a resolved tree of mappings as dotted key -> scalar or list.

    Empty mappings vanish; infinities and NaN become words.

    >>> flat_config({"schedule": {"max_steps": 100, "far": float("inf")}, "logger": {}})
    {'schedule.max_steps': 100, 'schedule.far': 'inf'}
    """
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
    """Return 12 hexadecimal digits of the SHA-256 of the configuration without ``IDENTITY_KEYS``; equal for repeats.

    >>> config_hash({"seed": 0, "schedule.max_steps": 100}) == config_hash({"seed": 1, "schedule.max_steps": 100})
    True
    """
    identity = without(config, IDENTITY_KEYS)
    if "trainer.devices" in identity:
        identity["trainer.devices"] = _number_of_devices(config)
    text = "\n".join(f"{key}={_canonical(value)}" for key, value in sorted(identity.items()))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _number_of_devices(config: Configuration) -> Setting:
    """How many devices share a step, whichever they are; one, unless a strategy says how several do."""
    devices = config["trainer.devices"]
    if isinstance(devices, list):
        return len(devices)
    alone = config.get("trainer.strategy") in (None, "auto")
    return 1 if alone and isinstance(devices, str) else devices


def without(config: Configuration, patterns: Iterable[str]) -> dict[str, Setting]:
    """Return the options whose keys match none of the patterns (``*`` matches anything, dots too).

    >>> without({"seed": 0, "data.root": "logs", "split.stride": 10}, ("seed", "data.*"))
    {'split.stride': 10}
    """
    patterns = tuple(patterns)
    return {key: value for key, value in config.items() if not any(fnmatchcase(key, one) for one in patterns)}


def only(config: Configuration, patterns: Iterable[str]) -> dict[str, Setting]:
    """Return the options whose keys match one of the patterns.

    >>> only({"seed": 0, "data.root": "logs", "split.stride": 10}, ("data.*",))
    {'data.root': 'logs'}
    """
    left = without(config, patterns)
    return {key: value for key, value in config.items() if key not in left}


def differing_options(configs: Sequence[Configuration], commands: Iterable[str] = ()) -> list[tuple[str, ...]]:
    """Return for each configuration the options in which it differs from any other, such as "split.stride=5".

    Options whose values vary alike count as interpolations of one option. That one is named: the one that a command
    gave, else the one with the shortest path. A part that some configurations lack reads "with loss.depth" or "without
    loss.depth".

    >>> differing_options([{"split.stride": 5, "lr": 0.1}, {"split.stride": 10, "lr": 0.1}])
    [('split.stride=5',), ('split.stride=10',)]

    Args:
        configs: the configurations of the runs that one table compares.
        commands: the commands that made them; options given there are always named.
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
    """Return the keys of the options that commands give.

    >>> sorted(given_keys(["train method=streetgs +loss.depth=0.1"]))
    ['loss.depth', 'method']
    """
    return {word.partition("=")[0].lstrip("+") for command in commands for word in command.split() if "=" in word}


def chosen_options(command: str) -> dict[str, str]:
    """Return the choices of groups that a command gives: the group, with its place where it has one -> the option.

    >>> chosen_options("sparsestreet train -m pruning@callback.pruning.rule=opacity render=fast seed=0 a.b=1")
    {'pruning@callback.pruning.rule': 'opacity', 'render': 'fast', 'seed': '0'}
    """
    words = (word.partition("=") for word in _words(command))
    given = ((key.lstrip("+"), equals, value) for key, equals, value in words)
    # A group has no dot of its own; what stands behind an @ is its place.
    return {key: value for key, equals, value in given if equals and "." not in key.partition("@")[0]}


def _words(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError:  # a quote without its end, in a record that somebody wrote by hand
        return command.split()


def key_of(option: str) -> str:
    """Return the key of an option as ``differing_options`` words it.

    >>> key_of("without loss.depth"), key_of("split.stride=5")
    ('loss.depth', 'split.stride')
    """
    return option.partition("=")[0].removeprefix("without ").removeprefix("with ")


def _missing_part(key: str, configs: Sequence[Configuration]) -> str | None:
    """Return the largest part of the tree around ``key`` that is absent from every configuration without the key.

    None if only the key itself is absent, or if no configuration lacks it.
    """
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
    """Return JSON in which 1 and 1.0 are the same: YAML tells them apart, but nobody means to."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, list):
        return f"[{', '.join(map(_canonical, value))}]"
    return json.dumps(value, sort_keys=True)
