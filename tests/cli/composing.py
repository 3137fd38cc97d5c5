"""Hydra's compositions in a quarter of their time: what depends on the chosen options alone is done once a process.

A composition reads some fifty files, joins them in the order of the defaults lists, and then sets the values of single
keys. Most tests differ in the values. The functions that are replaced are those of Hydra 1.3 and omegaconf
2.3.
"""

import copy
import os
import pickle
from abc import ABCMeta
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import astuple
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hydra._internal import config_loader_impl, defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository
from hydra._internal.defaults_list import DefaultsList, Overrides
from hydra.core.default_element import InputDefault, ResultDefault
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig, ListConfig, OmegaConf, base, grammar_parser, nodes
from omegaconf.base import ContainerMetadata, Metadata
from omegaconf.basecontainer import BaseContainer

_loader: Any = config_loader_impl
_load = ConfigRepository.load_config
_order = _loader.create_defaults_list
_choices = defaults_list._create_interpolation_map
_join = ConfigLoaderImpl._compose_config_from_defaults_list

# Pickled: read back in a fifth of the time of a deep copy.
_loaded: dict[Any, bytes] = {}
_ordered: dict[Any, DefaultsList] = {}
_joined: dict[Any, bytes] = {}


def speed_up() -> None:
    """For the whole process."""
    _replace(_load_once, _order_once, _choices_if_asked, _join_once)
    for kind in (Metadata, ContainerMetadata):
        setattr(kind, "__deepcopy__", _copied)  # noqa: B010 - pyright knows of no such method
    parsing: Any = base
    parsing.parse = _parsed_once
    kinds: list[Any] = [base.Node, base.Box, base.Container, BaseContainer, DictConfig, ListConfig]
    kinds += [nodes.ValueNode, nodes.AnyNode]
    for kind in kinds:
        kind.__class__ = _Plain


def as_shipped() -> None:
    """Back to Hydra's own."""
    _replace(_load, _order, _choices, _join)


def _replace(load: Callable, order: Callable, choices: Callable, join: Callable) -> None:
    internal: Any = ConfigLoaderImpl
    repository: Any = ConfigRepository
    repository.load_config = load
    _loader.create_defaults_list = order
    defaults_list._create_interpolation_map = choices
    internal._compose_config_from_defaults_list = join


def _load_once(repository: ConfigRepository, config_path: str) -> ConfigResult | None:
    """A file as it was read; who joins it changes it."""
    files = [Path(source.path, f"{config_path}.yaml") for source in repository.sources if source.scheme() == "file"]
    key = config_path, tuple((file, file.stat().st_mtime_ns) for file in files if file.is_file())
    if key not in _loaded:
        _loaded[key] = pickle.dumps(_load(repository, config_path))
    return pickle.loads(_loaded[key])


def _order_once(
    repo: CachingConfigRepository,
    config_name: str | None,
    overrides_list: list[Override],
    prepend_hydra: bool,
    skip_missing: bool,
) -> DefaultsList:
    """Values of keys do not change which files are joined."""
    single = [override for override in overrides_list if not override.is_sweep_override()]
    choices = [one for one in single if repo.group_exists(one.key_or_group) and not isinstance(one.value(), dict)]
    lines = tuple(one.input_line for one in choices)
    key = _stand(repo.delegate), config_name, lines, prepend_hydra, skip_missing
    if key not in _ordered:
        _ordered[key] = _order(repo, config_name, choices, prepend_hydra, skip_missing)
    found = copy.copy(_ordered[key])
    found.config_overrides = [override for override in single if override not in choices]
    return found


def _choices_if_asked(overrides: Overrides, defaults_list: list[InputDefault], self_added: bool) -> DictConfig:
    """Hydra lists all choices for each file, and looks at them where a file's defaults follow another choice."""
    if any(not one.is_self() and one.is_interpolation() for one in defaults_list):
        return _choices(overrides, defaults_list, self_added)
    return OmegaConf.create()


def _join_once(loader: ConfigLoaderImpl, defaults: list[ResultDefault], repo: CachingConfigRepository) -> DictConfig:
    key = _stand(repo.delegate), tuple(astuple(one) for one in defaults)
    if key not in _joined:
        with _parents_at_the_end():
            joined = _join(loader, defaults, repo)
        joined._re_parent()
        _joined[key] = pickle.dumps(joined)
    return pickle.loads(_joined[key])


@contextmanager
def _parents_at_the_end() -> Iterator[None]:
    """Each file that is joined sets the parents of all values before it anew."""
    box: Any = base.Box
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(box, "_re_parent", lambda values: None)
        yield


class _Plain(ABCMeta):
    """Of classes to which nobody registers others: ``isinstance``, of which a composition asks 60,000 times, need not
    look for those."""

    __instancecheck__ = type.__instancecheck__


_parsed_once = cache(grammar_parser.parse)
"""``${...}`` as a tree that is read, and never changed."""


def _copied(metadata: Metadata, memo: dict[int, Any]) -> Metadata:
    """What stands beside each value: types, names, and two small tables. A deep copy takes thirty times as long, and
    copies of configurations are a third of composing them and of making their parts."""
    copied = copy.copy(metadata)
    copied.flags = None if metadata.flags is None else metadata.flags.copy()
    copied.resolver_cache = copy.deepcopy(metadata.resolver_cache, memo)
    return copied


def _stand(repository: Any) -> tuple:
    """Where files are looked for, and which are there: a test may write its own."""
    return tuple((source.path, *_written(source)) for source in repository.get_sources())


def _written(source: ConfigSource) -> list[tuple[str, int]]:
    if source.scheme() != "file":
        return []
    return [(one.path, one.stat().st_mtime_ns) for below, _, _ in os.walk(source.path) for one in os.scandir(below)]
