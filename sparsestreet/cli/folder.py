"""The folder of a run: refused where another run lies there, taken once the data is read, left as it was found."""

import os
import shutil
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sparsestreet.cli.compose import load_run_config, resolved
from sparsestreet.cli.resume import run_of
from sparsestreet.records.configuration import Configuration, config_hash, flat_config, only
from sparsestreet.records.run import RUN, RunDescription
from sparsestreet.records.strict_json import RecordError

CONFIGURATION = ".hydra"
OF_A_RUN = (
    "scene.safetensors",
    "views.json",
    "run.json",
    "checkpoints",
    "records",
    "predictions",
    "curves",
    "pictures",
)
"""What a training leaves in its folder, besides its configuration and its log."""

_ALIKE = ("seed", "data.root", "data.log.root")
"""Beside the hash: what tells runs of one configuration apart and is part of no configuration's identity."""


def folder_problem(cfg: DictConfig, out: Path) -> str | None:
    """One line where ``out`` cannot be written, or holds a run that nobody asked to replace or to go on with."""
    there = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        return f"{out} cannot be written: name another place with out=..."
    goes_on = cfg.get("resume") and run_of(Path(cfg.resume)).resolve() == out.resolve()
    if goes_on or cfg.get("overwrite") or not holds_run(out):
        return None
    run = _description(out)
    if holds_same_run(cfg, out):
        if run is not None and run.steps >= run.max_steps:
            return (
                f"{out} holds this very run, finished: sparsestreet evaluate run={out}, or replace it: overwrite=true"
            )
        if any((out / "checkpoints").glob("[!.]*.ckpt")):
            return f"{out} holds this very run, unfinished: go on with resume={out}, or begin again: overwrite=true"
    said = f" ({run.label}, seed {run.seed})" if run else ""
    return f"{out} holds another run{said}: name another place with out=..., or replace it: overwrite=true"


def holds_run(out: Path) -> bool:
    """Whether something of a training is there; the configuration and log of one that never began do not count."""
    return any((out / name).exists() for name in OF_A_RUN)


def holds_same_run(cfg: DictConfig, out: Path) -> bool:
    """Whether the run in a folder has this configuration, seed and drive."""
    try:
        before = flat_config(resolved(load_run_config(out)))
    except (FileNotFoundError, OmegaConfBaseException, ValueError):
        return False
    return same_run(before, flat_config(resolved(cfg)))


def same_run(config: Configuration, other: Configuration) -> bool:
    """Whether two flat configurations are of one run, wherever it writes."""
    return config_hash(config) == config_hash(other) and only(config, _ALIKE) == only(other, _ALIKE)


def take_folder(cfg: DictConfig, out: Path) -> None:
    """Write the configuration of the run that begins or goes on; nothing of an earlier run stays beside a new one.

    Hydra would write it before the run is known to be one.
    """
    if not cfg.resume:
        for name in OF_A_RUN:
            path = out / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    folder = out / CONFIGURATION
    folder.mkdir(parents=True, exist_ok=True)
    hydra = HydraConfig.instance().cfg
    OmegaConf.save(cfg, folder / "config.yaml")
    OmegaConf.save(hydra, folder / "hydra.yaml")
    OmegaConf.save(HydraConfig.get().overrides.task, folder / "overrides.yaml")


def leave_folder(out: Path, log: str) -> None:
    """Remove configuration, log and folder of a start that failed before its first step, if nothing else is there."""
    if out.is_dir() and {path.name for path in out.iterdir()} <= {CONFIGURATION, log}:
        shutil.rmtree(out)


def _description(out: Path) -> RunDescription | None:
    try:
        return RUN.find(out)
    except RecordError:
        return None
