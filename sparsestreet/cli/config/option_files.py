"""Options of conf/: a file each, or together in conf/options/GROUP.yaml where they are short.

Hydra reads files of single options itself. Those of conf/options are registered here, under the same words:
``conf/options/experiment.yaml`` holds ``experiment=claim/node_aware``. Options of a user's own are files as ever.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_store import ConfigStore

PACKAGE = Path(__file__).resolve().parents[2]
# An installed wheel carries conf/ inside the package; a checkout has it beside the package.
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"

GLOBAL = "# @package _global_"
"""First line of a file whose keys begin at the root."""
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NAMED = ("effects", "loss", "callback", "source")
"""Groups of which several options are chosen at once: each stands below its own name."""


def config_files() -> Iterator[tuple[str, bool, Any]]:
    """Yield the path below conf/ of each option, without its ending, whether its keys are global, and its tree."""
    for path in sorted(CONF.rglob("*.yaml")):
        text, place = path.read_text(encoding="utf-8"), path.relative_to(CONF).with_suffix("")
        tree = yaml.load(text, LOADER) or {}
        if place.parts[0] != "options":
            yield place.as_posix(), text.startswith(GLOBAL), tree
            continue
        for name, option in tree.items():
            yield (
                f"{place.name}/{name}",
                text.startswith(GLOBAL),
                {name: option} if place.name in _NAMED else option or {},
            )


@cache
def options_of(group: str) -> tuple[str, ...]:
    """Return the names of the options of a group, sorted; none where conf/ has no such group."""
    names = (name.rpartition("/") for name, _, _ in config_files())
    return tuple(sorted(name for folder, _, name in names if folder == group))


def option_tree(group: str, name: str) -> Any:
    """Return what conf/ says of an option, as plain values."""
    return next(tree for place, _, tree in config_files() if place == f"{group}/{name}")


def _placed(group: str, name: str, option: Any) -> Any:
    return {name: option} if group in _NAMED else option or {}


def register_options() -> None:
    """Tell Hydra of the options in conf/options."""
    for path in (CONF / "options").glob("*.yaml"):
        package = "_global_" if path.read_text(encoding="utf-8").startswith(GLOBAL) else None
        for name, option in (yaml.load(path.read_text(encoding="utf-8"), LOADER) or {}).items():
            group, _, last = f"{path.stem}/{name}".rpartition("/")
            node = _placed(path.stem, name, option)
            ConfigStore.instance().store(name=last, node=node, group=group, package=package, provider="conf/options")


register_options()
