"""What the configuration of an opened run may name: a closed list, which is found by walking conf/.

A run's folder may come from anybody, and Hydra calls whatever a ``_target_`` names. So of a configuration that the
user's own words did not compose, each class, resolver and place to write to is one that conf/ names itself. Parts from
outside come from modules that the user's command trusts (``parts=[mypaper]``).
"""

import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra._internal.utils import _locate
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.config.compose import CONF, TrainSchema, config_files, load_run_config

# ``hydra.utils.get_object`` logs what it raises


Place = tuple[str, ...]
"""Keys from the root of a configuration to a value; items of lists by their numbers."""

TARGET = "_target_"
_RESERVED = ("_args_", "_partial_", "_convert_", "_recursive_")
"""What else Hydra reads of a part; conf/ says none of it."""
_FIXED = (("folder", None), ("logger", None), ("callback", "path"))
"""Root and last key of what decides where a run writes and whom it calls; None: all keys."""
_ROOTS = {entry.name for entry in fields(TrainSchema)}


@dataclass(frozen=True)
class ClosedList:
    """What the files of conf/ name."""

    targets: Mapping[str, frozenset[str]]
    """Class -> the root keys below which it may stand; none: anywhere."""
    values: frozenset[tuple[Place, str]]
    """Place and value of what stands below a root key, the value as ``repr``."""
    texts: frozenset[str]
    """Values with interpolations, as they are written."""
    resolvers: frozenset[str]


@cache
def named_by_conf() -> ClosedList:
    """Return the closed list. It leaves out ``hydra``, which is no part of a run."""
    targets: dict[str, set[str]] = {}
    values, texts = set(), set()
    for name, anywhere, tree in config_files():
        group = name.partition("/")[0]
        root = () if anywhere or name == group else (group,)
        for place, value in leaves(tree, root):
            if place[0] in ("hydra", "defaults"):
                continue
            if place[-1] == TARGET:
                targets.setdefault(str(value), set()).add(place[0] if place[0] in _ROOTS else "")
            if isinstance(value, str) and "${" in value:
                texts.add(value)
            values.add((place, repr(value)))
    for path in CONF.rglob("*.yaml"):
        for name in re.findall(r"#.*_target_: ([\w.]+)", path.read_text(encoding="utf-8")):  # offered in a comment
            folder = path.relative_to(CONF).parts[0]
            group = path.stem if folder == "options" else folder
            targets.setdefault(name, set()).add(group if group in _ROOTS else "")
    rooted = {name: frozenset() if "" in roots else frozenset(roots) for name, roots in targets.items()}
    resolvers = {name for text in texts for name in re.findall(r"\$\{([\w.]+):", text)}
    return ClosedList(rooted, frozenset(values), frozenset(texts), frozenset(resolvers))


def leaves(tree: object, place: Place = ()) -> Iterator[tuple[Place, object]]:
    """Yield every plain value with its place, in mappings and lists however deep."""
    items = tree.items() if isinstance(tree, Mapping) else enumerate(tree) if isinstance(tree, list | tuple) else None
    if items is None or (not tree and place):
        yield place, tree
        return
    for name, value in items:
        if name == TARGET:
            yield (*place, TARGET), value  # a mapping in its place is no name
        else:
            yield from leaves(value, (*place, str(name)))


def open_run_config(run: Path, parts: Sequence[str] = ()) -> DictConfig:
    """Return the configuration of a run whose parts are to be made: none was made or imported yet.

    ``parts`` are modules that the user's own command trusts: those that it names are imported.

    Raises what ``load_run_config`` raises, and ValueError, in one line, for what conf/ does not name.
    """
    check_modules(parts)
    cfg = load_run_config(run)
    tree = OmegaConf.to_container(cfg)
    check_received(tree, run / ".hydra" / "config.yaml", parts)
    for place, target in leaves(tree):
        if place[-1] == TARGET and target not in named_by_conf().targets:
            located(str(target), ".".join(place))
    return cfg


def check_received(
    tree: object, source: Path, parts: Sequence[str] = (), own: frozenset[tuple[Place, str]] = frozenset()
) -> None:
    """Raise ValueError, in one line, where a configuration that came with a run names what conf/ does not.

    Args:
        tree: plain values, interpolations as they are written.
        source: the file that is to be named.
        parts: modules that the user's own command trusts.
        own: places and values (``repr``) that the user's own words say.
    """
    for place, value in leaves(tree):
        if (place, repr(value)) in own:
            continue
        if problem := (_target_problem if place[-1] == TARGET else _value_problem)(place, value, parts):
            raise ValueError(f"{source}: {'.'.join(place)} {problem}")


def check_places(tree: object, source: Path, own: frozenset[tuple[Place, str]]) -> None:
    """Raise ValueError where a run that goes on would write to, or call, another place than conf/ says."""
    known = named_by_conf().values
    names = {place[1] for place, _ in known if place[0] == "trainer" and len(place) > 1}
    for place, value in leaves(tree):
        if (place, repr(value)) in own or value in (None, {}, []):
            continue
        fixed = any(place[0] == root and name in (None, place[-1]) for root, name in _FIXED)
        of_trainer = place[0] == "trainer" and not names & {*place[1:2]} and not isinstance(value, bool | int | float)
        if of_trainer or (fixed and (place, repr(value)) not in known):
            raise ValueError(
                f"{source}: {'.'.join(place)} is {_shown(value)}, and a run that was received does not choose where it "
                "writes or whom it calls: say the option again in this command if it is yours"
            )


def trusted(target: str, parts: Iterable[str]) -> bool:
    """Whether a class lies in one of the modules, or below it, by whole names.

    >>> trusted("mypaper.rules.Volume", ["mypaper"]), trusted("mypapers.Volume", ["mypaper"])
    (True, False)
    """
    return any(target == part or target.startswith(f"{part}.") for part in parts)


def check_modules(parts: Sequence[str]) -> None:
    """Raise ValueError for what ``parts=[...]`` cannot name."""
    for part in parts:
        if not re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*", part):
            raise ValueError(f"parts=[...] names modules, such as parts=[mypaper], got {part!r}")


def located(target: str, key: str) -> Any:
    """Return what a ``_target_`` names. Raises ValueError, naming the key in one line, where it cannot be imported."""
    try:
        return _locate(target)
    except ImportError as error:
        package = target.partition(".")[0]
        if find_spec(package) is None:
            raise ValueError(f"{key}: there is no module {package}; is its folder in PYTHONPATH?") from error
        reason = " ".join(str(error.__cause__ or error).split())
        raise ValueError(f"{key} names {target}, which cannot be imported: {reason}") from error


def made(part: Any) -> Any:
    """Return what a configuration describes. Raises what its class raises, else ValueError in one line."""
    try:
        return instantiate(part, _convert_="all")
    except InstantiationException as error:
        if isinstance(error.__cause__, OSError | ValueError):
            # Hydra's own words name the target; the cause says what to do.
            raise error.__cause__ from None
        reason, _, key = str(error).partition("\nfull_key: ")
        raise ValueError(f"{key or 'a part'} cannot be made: {' '.join(reason.split())}") from error


def _target_problem(place: Place, value: object, parts: Sequence[str]) -> str | None:
    if isinstance(value, str):
        roots = named_by_conf().targets.get(value)
        if trusted(value, parts) or (roots is not None and (not roots or place[0] in roots)):
            return None
        if roots is not None:
            return f"names {value!r}, which conf/ names below {' and '.join(sorted(roots))} alone: nothing was made"
        package = value.partition(".")[0]
        if package == "sparsestreet":
            return f"names {value!r}, which conf/ does not: another version wrote the run, or do not trust it"
        if package in sys.stdlib_module_names:
            return f"names {value!r}, which is no part of a scene: nothing was made, and this run is not to be trusted"
        if re.fullmatch(r"\w+(\.\w+)+", value):
            module = value.rpartition(".")[0]
            return f"names {value!r}, which conf/ does not: say parts=[{module}] if its code is trusted"
    return f"is {_shown(value)}, which names no class: nothing was made"


def _value_problem(place: Place, value: object, parts: Sequence[str]) -> str | None:
    if not parts and (reserved := next((name for name in place if name in _RESERVED), None)):
        return f"is Hydra's {reserved}, which conf/ never says: leave it out"
    return _interpolation_problem(value)


def _interpolation_problem(value: object) -> str | None:
    known = named_by_conf()
    if not isinstance(value, str) or "${" not in value or value in known.texts:
        return None
    asked = re.findall(r"\$\{\s*([^{}]*)", value)
    names = (re.fullmatch(r"([\w.]+)\s*:.*", one, re.DOTALL) for one in asked)
    fine = all(
        named[1] in known.resolvers if named else re.fullmatch(r"[\w.\[\]@]+\s*", one)
        for one, named in zip(asked, names, strict=True)
    )
    if fine and TARGET not in value and not any(name in value for name in _RESERVED):
        return None
    return f"is {_shown(value)}, which asks for what conf/ never asks for: write its value in the place"


def _shown(value: object, most: int = 100) -> str:
    text = repr(value)
    return text if len(text) <= most else f"{text[:most]}..."
