"""``sparsestreet data check`` and ``sparsestreet data make``."""

import copy
import sys
from pathlib import Path

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.auto import AUTO, with_found_data
from sparsestreet.cli.compose import composed, override_problem
from sparsestreet.data.check import report_check
from sparsestreet.data.reader import LogReader

USAGE = """\
sparsestreet data check DIR [data=nuscenes data.log.scene=scene-0061 data.log.last_frame=50 ...]
    print everything that is wrong with a log, or with the part that is chosen (exit status 1), or its summary;
    without data=... the folder's files tell which reader is asked
sparsestreet data make [seed=N] [data.log.settings.width=W ...]
    write a synthetic street, and print where it lies
"""


_NO_LOG = "no log is named: say sparsestreet data check DIR, DIR being the folder of a log"


class _UsageError(ValueError):
    """The command is not one that can be followed."""


def data(arguments: list[str]) -> int:
    """Run the sub-command; 2 on wrong usage."""
    verb, rest = (arguments[0], arguments[1:]) if arguments else ("", [])
    if verb not in ("check", "make") or "--help" in rest:
        print(USAGE)
        return 0 if verb in ("-h", "--help") or "--help" in rest else 2
    try:
        return _check(rest) if verb == "check" else _make(rest)
    except (ValueError, OSError) as error:
        print(f"sparsestreet data {verb}: {error}", file=sys.stderr)
        return 2


def _check(arguments: list[str]) -> int:
    folders = [text for text in arguments if "=" not in text and not text.startswith("-")]
    overrides = [text for text in arguments if text not in folders]
    if not any(text.startswith("data=") for text in overrides):
        overrides = [AUTO, *overrides]
    if len(folders) > 1:
        raise _UsageError(_one_log(arguments))
    if AUTO in overrides and not folders and not any(text.startswith("data.root=") for text in overrides):
        raise _UsageError(_NO_LOG)
    overrides, found = with_found_data(overrides, Path(folders[0]) if folders else None)
    cfg = _compose(overrides)
    if folders and "root" not in set(cfg.data):
        raise _UsageError(_one_log(arguments))
    if folders:
        # Not as an override: Hydra's grammar would want some characters of a path in quotes.
        OmegaConf.update(cfg, "data.root", folders[0])
    if OmegaConf.is_missing(cfg.data, "root"):
        raise _UsageError(_NO_LOG)
    if missing := sorted(OmegaConf.missing_keys(cfg.data.log)):
        raise _UsageError(f"{missing[0]} has no value: give {missing[0]}=...")
    if found:
        print(found)
    return report_check(_reader(cfg))


def _one_log(arguments: list[str]) -> str:
    return f"one recorded log is checked at a time, got {' '.join(arguments)}: name one folder"


def _make(overrides: list[str]) -> int:
    cfg = _compose(overrides)
    if "root" in set(cfg.data):
        raise _UsageError("only data=synthetic can be made; a recorded drive is read as it is")
    reader = _reader(cfg)
    log = reader.read()
    print(f"{reader.folder}: {log.num_frames} frames of {log.num_cameras} cameras")
    return 0


def _compose(overrides: list[str]) -> DictConfig:
    problem = override_problem(overrides)
    if problem:
        raise _UsageError(problem)
    return copy.deepcopy(composed(overrides))


def _reader(cfg: DictConfig) -> LogReader:
    try:
        return instantiate(cfg.data.log, _convert_="all")
    except InstantiationException as error:
        # Hydra's own words name the target; the cause says what to do.
        raise error.__cause__ or error from None
