"""A run begins with the checkpoint of one that differs only in what it prunes from there on: a branch of its trunk.

All steps before the first pruning are the same steps, so a branch ends with the bits of a run that began at step 0.
"""

import logging
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from sparsestreet.cli.compose import load_run_config, resolved
from sparsestreet.cli.folder import configuration_of, identity_of_run, is_whole, lies_in
from sparsestreet.cli.resume import run_of
from sparsestreet.records.configuration import IDENTITY_KEYS, Configuration, flat_config, without
from sparsestreet.records.run import BRANCH_OF, BranchOf, moment_of

log = logging.getLogger(__name__)

OF_PRUNING = (
    "callback.pruning.*",
    # What these lead to is compared where it acts.
    "schedule.removal_at",
    "schedule.removal_db",
    "sparsify.name",
    "sparsify.label",
    "sparsify.control",
    "sparsify.published",
    # Floors and rights that pruning alone asks for.
    "node.*.min_instance_gaussians",
    "node.*.prunable",
)
"""Options that act when something is pruned, and never before."""

_OF_MASKS_TOO = ("node.*.min_gaussians",)
"""Floors that masks keep as well, where there are any."""


def moments_to_keep(cfg: DictConfig) -> tuple[float, ...]:
    """The moments of ``branch_points`` before which this run leaves a checkpoint: none once it has pruned itself.

    A run of so many minutes has none: what a step is follows from the clock.
    """
    first = first_pruning(flat_config(resolved(cfg)))
    return () if cfg.budget.minutes else tuple(moment for moment in cfg.branch_points if moment <= first)


def first_pruning(config: Configuration) -> float:
    """The fraction of a run at which something is pruned first; infinity: never."""
    at = config.get("callback.pruning.at")
    return min(at, default=math.inf) if isinstance(at, list) else math.inf


def is_branch(config: Configuration, trunk: Configuration, moment: float) -> bool:
    """Whether two runs have the same steps up to a moment: they differ in what is pruned from there on alone."""
    late = all(moment <= first_pruning(one) for one in (config, trunk))
    return late and identity_of_trunk(config) == identity_of_trunk(trunk)


def identity_of_trunk(config: Configuration) -> tuple[str, ...]:
    """What runs have in common whose steps are the same until one of them prunes."""
    masked = any(value is True for key, value in config.items() if re.fullmatch(r"node\.\w+\.masked", key))
    return identity_of_run(without(config, OF_PRUNING if masked else (*OF_PRUNING, *_OF_MASKS_TOO)))


def check_resumed(config: dict[str, Any], start: Path) -> None:
    """Raises ValueError, naming the options, where a run would go on with another configuration than its own.

    From a checkpoint that was kept before a moment, another folder may prune otherwise from there on.
    """
    run, moment = run_of(start), moment_of(start)
    before, now = flat_config(resolved(load_run_config(run))), flat_config(config)
    old, new = (without(flat, (*IDENTITY_KEYS, "trainer.*")) for flat in (before, now))
    elsewhere = Path(str(now.get("out"))).resolve() != run.resolve()
    if moment is not None and elsewhere and is_branch(new, old, moment):
        old = new
    changed = [key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key)]
    if before.get("seed") != now["seed"]:
        changed.insert(0, "seed")
    if changed:
        said = ", ".join(f"{key} ({old.get(key, before.get(key))} before)" for key in changed[:3])
        raise ValueError(f"a run goes on as it began, but {len(changed)} options differ: {said}; start a new run")


def trunk_of(cfg: DictConfig, out: Path) -> Path | None:
    """The latest checkpoint that this job of a sweep can begin with, of a finished run in a sweep beside it or its own.

    None: there is none, none is wanted, or this is no job of a sweep. Of several processes each would look for itself,
    so a run that they share begins at step 0; ``resume=CHECKPOINT`` names one for all.
    """
    first = first_pruning(config := flat_config(resolved(cfg)))
    wanted = cfg.reuse and not cfg.overwrite and not cfg.budget.minutes
    if not wanted or math.isinf(first) or _is_shared(config) or HydraConfig.get().mode != RunMode.MULTIRUN:
        return None
    sweeps = Path(HydraConfig.get().sweep.dir).absolute().parent
    for moment, checkpoint in sorted(_kept(sweeps), key=lambda kept: (-kept[0], kept[1])):
        run = checkpoint.parents[1]
        if moment > first or run == out.absolute() or not is_whole(run):
            continue
        trunk = configuration_of(run)
        if trunk is not None and is_branch(config, trunk, moment):
            return checkpoint
    return None


def record_branch(out: Path, start: Path | None) -> None:
    """Write down which run's checkpoint a run began with, where that is another one's."""
    moment = None if start is None else moment_of(start)
    if start is None or moment is None or lies_in(start, out):
        return
    trunk = run_of(start)
    log.info("begins with %s, with which it has all steps up to there in common", start)
    BRANCH_OF.write(out, BranchOf(run=os.path.relpath(trunk, out), label=load_run_config(trunk).name, moment=moment))


def _kept(sweeps: Path) -> Iterator[tuple[float, Path]]:
    for checkpoint in sweeps.glob("*/*/checkpoints/before_*.ckpt"):
        moment = moment_of(checkpoint)
        if moment is not None:
            yield moment, checkpoint


def _is_shared(config: Configuration) -> bool:
    return any(key.startswith("trainer.strategy") and value not in (None, "auto") for key, value in config.items())
