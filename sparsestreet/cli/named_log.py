"""The log that the words of a command name, and its reader."""

import copy
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.auto import AUTO, with_found_data
from sparsestreet.cli.checks import unresolvable
from sparsestreet.cli.compose import as_typed, composed
from sparsestreet.cli.problems import override_problem
from sparsestreet.cli.targets import made
from sparsestreet.data.reader import LogReader


class UsageError(ValueError):
    """The command is not one that can be followed."""


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


def reader_of(cfg: DictConfig) -> LogReader:
    """Raises what the reader's class raises for its values, as ``made`` does."""
    return made(cfg.data.log)
