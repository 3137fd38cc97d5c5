"""``data=auto``: which option of conf/data a folder is for, by the marks of each option's reader.

The options are those of every conf folder that Hydra searches, so a reader of one's own is among them.
"""

import copy
import importlib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.config.compose import as_typed, composed, configuration
from sparsestreet.cli.config.targets import made
from sparsestreet.cli.config.validate import override_problem, unresolvable

if TYPE_CHECKING:
    from sparsestreet.data.reader import FolderSignature, LogReader

AUTO = "data=auto"
_MORE = "docs/datasets/README.md says what is read"
_ABOVE = 2
"""Folders above a wrong root that are looked at."""
_NEIGHBORS = 50
"""Folders below a wrong root that are looked at."""


def with_found_data(arguments: Sequence[str], root: Path | None = None) -> tuple[list[str], str | None]:
    """The arguments with the option that ``data=auto`` stands for, and a sentence that says why; None without it.

    Args:
        arguments: of a command.
        root: the folder, where it is not given as ``data.root``.

    Raises ValueError where no reader or more than one knows the folder, or it is not given.
    """
    if any(text.startswith("data=") and "auto" in text[5:].split(",") and text != AUTO for text in arguments):
        raise ValueError("data=auto looks at one folder; name the readers of a sweep")
    if AUTO not in arguments:
        return list(arguments), None
    root = _root_of(arguments) if root is None else root
    name, why = found_option(root, [text for text in arguments if text.startswith("hydra.searchpath=")])
    return [f"data={name}" if text == AUTO else text for text in arguments], f"data={name}, as {why} tells"


def found_option(root: Path, searchpath: Sequence[str] = ()) -> tuple[str, Path]:
    """The option of conf/data whose reader knows a folder, and the file that tells. Raises ValueError."""
    if not root.is_dir():
        what = "is a file" if root.exists() else "is not there"
        raise ValueError(f"data.root={root} {what}: name the folder of a log")
    if not any(root.iterdir()):
        raise ValueError(f"data.root={root} is an empty folder: name that of a log; {_MORE}")
    marks = _marks_of_options(tuple(searchpath))
    known = _known_as(root, marks)
    if len(known) == 1:
        return next(iter(known.items()))
    if known:
        told = " and ".join(f"data={name} ({path} is there)" for name, path in known.items())
        raise ValueError(f"{root} has the files of {told}: name the one that is meant")
    from sparsestreet.data.reader import UNREAD  # with torch

    for unread in UNREAD:
        if path := unread.marks.found_in(root):
            raise ValueError(f"{root} is {unread.name}, as {path.name} tells, which is not read: {unread.remedy}")
    if (near := _nearby(root, marks)) is not None:
        raise ValueError(f"no reader knows {root}, but {near[0]} is for data={near[1]}: name that folder")
    missed = "".join(f"\n  data={name}: {one}" for name, one in marks.items())
    raise ValueError(f"no reader knows {root}; {_MORE}. There is none of{missed}")


def _root_of(arguments: Sequence[str]) -> Path:
    given = [text for text in arguments if text.startswith("data.root=")]
    if not given:
        raise ValueError("data=auto needs a folder to look at: give data.root=DIR")
    override = OverridesParser.create().parse_override(given[-1])
    if override.is_sweep_override():
        raise ValueError("data=auto looks at one folder, data.root names several: name the reader, data=...")
    return Path(str(override.value()))


@cache
def _marks_of_options(searchpath: tuple[str, ...]) -> "dict[str, FolderSignature]":
    """Of every option with a root whose reader states its marks."""
    with configuration():
        loader = GlobalHydra.instance().config_loader()
        options = loader.get_group_options("data", ObjectType.CONFIG, config_name="train", overrides=list(searchpath))
        every = compose(None, [*searchpath, *(f"+data@{name}={name}" for name in options)])
    readers = {name: _reader_of(name, every[name].log._target_) for name in options if "root" in set(every[name])}
    return {name: reader.marks for name, reader in readers.items() if getattr(reader, "marks", None)}


def _reader_of(name: str, target: str) -> Any:
    module, _, reader = target.rpartition(".")
    try:
        return getattr(importlib.import_module(module), reader)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"data={name} names {target}, which cannot be imported: {error}") from error


def _known_as(root: Path, marks: "Mapping[str, FolderSignature]") -> dict[str, Path]:
    """Option -> the file that tells."""
    return {name: path for name, one in marks.items() if (path := one.found_in(root))}


def _nearby(root: Path, marks: "Mapping[str, FolderSignature]") -> tuple[Path, str] | None:
    """A folder that a reader knows, around a wrong one or in it, and the option."""
    inside = root.absolute()
    for above in inside.parents[:_ABOVE]:
        for name, one in marks.items():
            if one.tell_of(inside, above):
                return above, name
    below = sorted(path for path in root.iterdir() if path.is_dir())[:_NEIGHBORS]
    return next(((folder, name) for folder in below for name in _known_as(folder, marks)), None)


class UsageError(ValueError):
    """The command is not one that can be followed."""


def without_folder(words: Sequence[str], one_log: str) -> tuple[list[str], Path | None]:
    """Return the words without the folder of a log, and the folder; None where it is not among them.

    Raises UsageError, which begins with ``one_log``, for several folders, and for ``out=...``, which such commands do
    not have.
    """
    folders = [text for text in words if "=" not in text and not text.startswith("-")]
    if written := [text for text in words if text.startswith("out=")]:
        raise UsageError(f"out= is of trainings: say to={written[0].partition('=')[2]} for the folder that is written")
    if len(folders) > 1:
        raise UsageError(f"{one_log}, got {' '.join(folders)}")
    return [text for text in words if text not in folders], Path(folders[0]) if folders else None


def configured_log(
    overrides: Sequence[str], folder: Path | None, *, no_log: str, one_log: str
) -> tuple[DictConfig, str | None]:
    """The configuration with the log, and what told whose files they are, where that was to be found out.

    Args:
        overrides: of Hydra; without ``data=`` the folder's files tell the reader.
        folder: of the log, where it is not given as ``data.root``.
        no_log: the error where none is given.
        one_log: the error where a folder is given to a reader that has none.

    Raises UsageError.
    """
    words = as_typed(list(overrides))
    if not any(text.startswith("data=") for text in words):
        words = [AUTO, *words]
    if AUTO in words and folder is None and not any(text.startswith("data.root=") for text in words):
        raise UsageError(no_log)
    words, found = with_found_data(words, folder)
    cfg = compose_data(words)
    if folder is not None:
        if "root" not in set(cfg.data):
            raise UsageError(one_log)
        # Not as an override: Hydra's grammar would want some characters of a path in quotes.
        OmegaConf.update(cfg, "data.root", str(folder))
    if OmegaConf.is_missing(cfg.data, "root"):
        raise UsageError(no_log)
    if problem := unresolvable(cfg.data.log):
        raise UsageError(problem)
    if missing := sorted(OmegaConf.missing_keys(cfg.data.log)):
        raise UsageError(f"{missing[0]} has no value: give {missing[0]}=...")
    return cfg, found


def compose_data(overrides: Sequence[str]) -> DictConfig:
    """A configuration of one's own. Raises UsageError for overrides that do not compose."""
    problem = override_problem(list(overrides))
    if problem:
        raise UsageError(problem)
    return copy.deepcopy(composed(overrides))


def reader_of(cfg: DictConfig) -> "LogReader":
    """Raise what the reader's class raises for its values, as ``made`` does."""
    return made(cfg.data.log)
