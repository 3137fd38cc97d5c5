"""The folder of a run: refused where another run lies there, taken once the data is read, left as it was found."""

import logging
import os
import re
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from sparsestreet.atomic import atomic_file
from sparsestreet.cli.config.compose import load_run_config, resolved
from sparsestreet.cli.config.targets import leaves
from sparsestreet.cli.runs.resume import has_checkpoint, run_of
from sparsestreet.records.configuration import Configuration, config_hash, flat_config, only
from sparsestreet.records.costs import COSTS
from sparsestreet.records.file import check_links
from sparsestreet.records.run import RUN, RunDescription
from sparsestreet.records.strict_json import RecordError

log = logging.getLogger(__name__)

CONFIGURATION = ".hydra"
OF_A_RUN = (
    "scene.safetensors",
    "views.json",
    "rig.json",
    "run.json",
    "checkpoints",
    "records",
    "predictions",
    "curves",
    "pictures",
)
"""What a training leaves in its folder, besides its configuration and its log."""

_TEMPORARY = re.compile(r"\..+\.\d+\.tmp(\.\w+)?")
"""Names of ``atomic_file``, with the number of the process."""

_ALIKE = ("seed", "data.root", "data.log.root")
"""Beside the hash: what tells runs of one configuration apart and is part of no configuration's identity."""


def folder_problem(cfg: DictConfig, out: Path) -> str | None:
    """One line where ``out`` cannot be written, has links out of it, or holds a run that nobody asked to replace or
    to go on with."""
    if reason := _unwritable(out):
        return f"{out} cannot be written ({reason}): name another place with out=..."
    try:
        check_links(out)
    except OSError as error:
        return str(error)
    if _is_resumed(cfg, out) or cfg.get("overwrite") or not holds_run(out):
        return None
    run = _description(out)
    if holds_same_run(cfg, out):
        if run is None or run.steps < run.max_steps or not is_whole(out):
            return None  # it goes on
        return f"{out} holds this very run, finished: sparsestreet evaluate run={out}, or replace it: overwrite=true"
    said = f" ({run.label}, seed {run.seed})" if run else ""
    return f"{out} holds another run{said}: name another place with out=..., or replace it: overwrite=true"


def _unwritable(out: Path) -> str | None:
    """Why a folder cannot be made or written to; None where it can. What is made to see it is removed again.

    Asked by doing: some file systems (/proc) refuse what permissions allow. One that is there stays as it is.
    """
    made: list[Path] = []
    try:
        if out.is_dir():
            return None if os.access(out, os.W_OK | os.X_OK) else "Permission denied"
        absent = [folder for folder in (out.absolute(), *out.absolute().parents) if not folder.exists()]
        for folder in reversed(absent):
            folder.mkdir(exist_ok=True)
            made.append(folder)
        with tempfile.TemporaryDirectory(dir=out, prefix="."):
            return None
    except OSError as error:
        return error.strerror or str(error)
    finally:
        with suppress(OSError):  # somebody else has begun to write there
            for folder in reversed(made):
                folder.rmdir()


def start_of(cfg: DictConfig, out: Path) -> Path | None:
    """The run or checkpoint that training in this folder goes on from; None: it begins.

    A folder that holds this very run, unfinished, goes on from its newest checkpoint without being asked: so does a job
    that was ended by others. One that was ended before its first checkpoint begins again.
    """
    own = holds_run(out) and not cfg.get("overwrite") and not _is_resumed(cfg, out) and holds_same_run(cfg, out)
    if own and has_checkpoint(out):
        log.info("%s holds this run, unfinished: it goes on from its newest checkpoint", out)
        return out
    if own:
        log.info("%s holds this run, ended before its first checkpoint: it begins again", out)
    return Path(cfg.resume) if cfg.get("resume") else None


def _is_resumed(cfg: DictConfig, out: Path) -> bool:
    return bool(cfg.get("resume")) and run_of(Path(cfg.resume)).resolve() == out.resolve()


def lies_in(start: Path, out: Path) -> bool:
    """Whether a run, or one of its checkpoints, is this folder's own."""
    return start.resolve().is_relative_to(out.resolve())


def holds_run(out: Path) -> bool:
    """Whether something of a training is there; the configuration and log of one that never began do not count."""
    return any((out / name).exists() for name in OF_A_RUN)


def is_whole(out: Path) -> bool:
    """Whether the command that trained a run came to its end; what it took is the last that it writes."""
    try:
        costs = COSTS.find(out)
    except RecordError:
        return False
    return costs is not None and costs.wall_seconds is not None


def holds_same_run(cfg: DictConfig, out: Path) -> bool:
    """Whether the run in a folder has this configuration, seed and drive."""
    before = configuration_of(out)
    return before is not None and same_run(before, flat_config(resolved(cfg)))


def configuration_of(run: Path) -> Configuration | None:
    """What a run's folder says of it; None: nothing that can be read today."""
    try:
        return flat_config(resolved(load_run_config(run)))
    except (FileNotFoundError, OmegaConfBaseException, ValueError, YAMLError):
        return None


def same_run(config: Configuration, other: Configuration) -> bool:
    """Whether two flat configurations are of one run, wherever it writes."""
    return identity_of_run(config) == identity_of_run(other)


def identity_of_run(config: Configuration) -> tuple[str, ...]:
    """What two flat configurations of one run have in common: options, seed, drive (by whatever path)."""
    found = only(config, _ALIKE)
    drive = {key: os.path.abspath(value) if isinstance(value, str) else value for key, value in found.items()}
    return config_hash(config), *(f"{key}={value}" for key, value in sorted(drive.items()))


def take_folder(cfg: DictConfig, out: Path, goes_on: bool) -> None:
    """Write the configuration of the run that begins or goes on; nothing of an earlier run stays beside a new one.

    Hydra would write it before the run is known to be one. What a kill left of files that were being written goes:
    nobody else writes here (``locks.sole_writer``).

    Raises OSError for a link that leads out of the folder.
    """
    check_links(out)
    for half_written in [path for path in out.rglob(".*.tmp*") if _TEMPORARY.fullmatch(path.name) and path.is_file()]:
        half_written.unlink()
    if not goes_on:
        for name in OF_A_RUN:
            path = out / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    folder = out / CONFIGURATION
    folder.mkdir(parents=True, exist_ok=True)
    config = _without_environment(cfg)
    said = {"overrides": HydraConfig.get().overrides.task, "hydra": HydraConfig.instance().cfg, "config": config}
    for name, part in said.items():
        with atomic_file(folder / f"{name}.yaml") as temporary:
            OmegaConf.save(part, temporary)


def _without_environment(cfg: DictConfig) -> DictConfig:
    """What a configuration takes from the environment, as values: of a run that is opened nothing may ask for it."""
    known = cfg.copy()
    for place, value in leaves(OmegaConf.to_container(cfg)):
        if isinstance(value, str) and "${oc.env:" in value:
            OmegaConf.update(known, ".".join(place), OmegaConf.select(cfg, ".".join(place)))
    return known


def leave_folder(out: Path, log: str) -> None:
    """Remove configuration, log and folder of a start that failed before its first step, if nothing else is there.

    What another process is at has its lock there.
    """
    if out.is_dir() and not out.is_symlink() and {path.name for path in out.iterdir()} <= {CONFIGURATION, log}:
        shutil.rmtree(out)


def _description(out: Path) -> RunDescription | None:
    try:
        return RUN.find(out)
    except RecordError:
        return None
