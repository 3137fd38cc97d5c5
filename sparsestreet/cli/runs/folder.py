"""The folder of a run: what it goes on from or begins with, refused where another run lies there, left as found."""

import logging
import math
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from sparsestreet.atomic import atomic_file
from sparsestreet.cli.config.compose import configuration, load_run_config, quoted, resolved, value_of, without_flags
from sparsestreet.cli.config.targets import check_modules, check_places, check_received, leaves
from sparsestreet.cli.process import shares_a_run
from sparsestreet.files import read_yaml
from sparsestreet.naming import checkpoint_fraction
from sparsestreet.records.configuration import IDENTITY_KEYS, Configuration, config_hash, flat_config, only, without
from sparsestreet.records.costs import COSTS
from sparsestreet.records.file import check_links
from sparsestreet.records.run import RUN, RunDescription
from sparsestreet.records.strict_json import RecordError

_PASSING = {"overrides", "runtime", "sweeper", "sweep"}
"""Keys of hydra's own configuration that follow from the words, or act in sweeps alone."""


def resumed_overrides(arguments: list[str], parts: Sequence[str] = ()) -> list[str]:
    """The overrides of the run that ``resume=RUN`` (or one of its checkpoints) names, then those that were given.

    An option that is given again counts as it is given now. The run's folder is gone on in, unless ``out=`` names
    another, or the checkpoint is one that was kept before a moment: a branch has a folder of its own. Without
    ``resume=`` they are as given.

    The run's own may come from anybody: what they name beyond conf/ must lie in ``parts``, modules that the user's own
    command trusts, or be said in this command.

    Raises FileNotFoundError where no run is at that place, ValueError in a sweep, and for what is not to be trusted.
    """
    given = next((value_of(text) for text in arguments if text.startswith("resume=")), "null")
    if given in ("null", "None", ""):
        return arguments
    if {"-m", "--multirun"} & set(arguments):
        raise ValueError("a sweep cannot go on with one run: leave out -m or resume")
    run = run_of(Path(given))
    load_run_config(run)  # says what a run's folder is, where this is none
    if is_whole(run) and Path(given).is_dir() and not (run / "checkpoints" / "last.ckpt").is_file():
        raise FileNotFoundError(
            f"resume={given}: it is finished and gave its checkpoint back: sparsestreet evaluate run={run} measures it "
            "again; to go on from a finished run, train it with keep_checkpoints=true"
        )
    if not has_checkpoint(run):
        raise FileNotFoundError(
            f"resume={given}: it was ended before its first checkpoint (checkpoint_every=...): start it again with "
            f"its own options and out={run}"
        )
    source = run / ".hydra" / "overrides.yaml"
    overrides = read_yaml(source, yaml.safe_load)
    if not isinstance(overrides, list):
        raise ValueError(f"{source} is damaged: it holds no list of options")
    branches = checkpoint_fraction(Path(given)) is not None
    folder = [] if branches or any(text.startswith("out=") for text in arguments) else [f"out={quoted(str(run))}"]
    return [
        *received_words(map(str, overrides), ("resume", "out", "overwrite"), [*arguments, *folder], source, parts),
        *arguments,
        *folder,
    ]


def received_words(
    words: Iterable[str], left: Iterable[str], typed: list[str], source: Path, parts: Sequence[str] = ()
) -> list[str]:
    """The words of a run that came from anybody, without those that are left out or said again in this command.

    Args:
        words: overrides, as the run has them.
        left: keys that are left out.
        typed: the words of the user's own command.
        source: what is named in an error.
        parts: modules that the user's command trusts.

    Raises ValueError where they choose what only the user's own words may.
    """
    own = {*left, *map(_key_of, typed)}
    kept = [text for text in words if _key_of(text) not in own]
    _check_words(kept, without_flags(typed), source, parts)
    return kept


def _check_words(received: list[str], typed: list[str], source: Path, parts: Sequence[str]) -> None:
    """Raise ValueError where words that came with a run choose what only the user's own may."""
    check_modules(parts)
    for text in received:
        if text.startswith("-") or "hydra" in text.partition("=")[0] or _key_of(text) == "folder":
            raise ValueError(
                f"{source} has {text[:100]!r}: a run that was received chooses no flag, no folder and nothing of "
                "Hydra's; take it out, and say it in this command if it is yours"
            )
    try:
        merged = _raw([*received, *typed])
    except (HydraException, OmegaConfBaseException, ValueError):
        return  # nothing is made of words that do not compose; ``override_problem`` says why
    plain = _own([*typed])
    hydra, own = merged.pop("hydra"), plain.pop("hydra")
    for one in (hydra, own):
        one["job"].pop("override_dirname", None)  # which follows from the words
    if changed := [key for key in hydra.keys() - _PASSING if hydra[key] != own.get(key)]:
        raise ValueError(f"{source} changes hydra.{changed[0]}, which a run that was received does not choose")
    said = frozenset((place, repr(value)) for place, value in leaves(plain))
    check_received(merged, source, parts, said)
    check_places(merged, source, said)


def _own(typed: list[str]) -> dict[str, Any]:
    """The configuration of the user's words alone; of those of Hydra's, where the others need the run's."""
    for words in (typed, [text for text in typed if text.startswith("hydra")]):
        try:
            return _raw(words)
        except (HydraException, OmegaConfBaseException, ValueError):
            continue
    return _raw([])


def _raw(words: list[str]) -> dict[str, Any]:
    """As plain values, interpolations as they are written."""
    with configuration():
        cfg: Any = OmegaConf.to_container(compose("train", words, return_hydra_config=True))
    return cfg


def _key_of(override: str) -> str:
    return override.partition("=")[0].lstrip("+~")


def run_of(path: Path) -> Path:
    """The folder of a run, given as it is or by one of its checkpoints."""
    if not path.exists():
        raise FileNotFoundError(f"resume={path}: there is nothing; give a run's folder or one of its checkpoints")
    return path if path.is_dir() else path.resolve().parents[1]


def has_checkpoint(run: Path) -> bool:
    """Whether a run has one that is whole."""
    return any((run / "checkpoints").glob("[!.]*.ckpt"))


log = logging.getLogger(__name__)

CONFIGURATION = ".hydra"
TRACKS_FILE = f"{CONFIGURATION}/tracks.json"
"""Objects that a run has found, beside what it was asked: who opens it sees these, not what a newer version finds."""
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
        (out / TRACKS_FILE).unlink(missing_ok=True)
    folder = out / CONFIGURATION
    folder.mkdir(parents=True, exist_ok=True)
    config = without_environment(cfg)
    said = {"overrides": HydraConfig.get().overrides.task, "hydra": HydraConfig.instance().cfg, "config": config}
    for name, part in said.items():
        with atomic_file(folder / f"{name}.yaml") as temporary:
            OmegaConf.save(part, temporary)


def without_environment(cfg: DictConfig) -> DictConfig:
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


def give_back(cfg: DictConfig, out: Path, *, of_sweep: bool) -> None:
    """Remove the checkpoints of a finished run that no run needs, and say how large they were.

    The last one always goes. Those of ``branch_points`` stay where they were asked for by hand, and in a sweep with its
    trunk, until ``give_back_trunk``. A run that is not finished, or has ``keep_checkpoints``, keeps all.
    """
    if cfg.keep_checkpoints or not is_whole(out):
        return
    trunk = bool(cfg.trunk) and os.path.abspath(cfg.trunk) == os.path.abspath(out)
    _remove(out, [path for path in _checkpoints(out) if checkpoint_fraction(path) is None or (of_sweep and not trunk)])


def give_back_trunk(out: Path) -> None:
    """Remove what branches began with, once all of them stand finished."""
    _remove(out, [path for path in _checkpoints(out) if checkpoint_fraction(path) is not None])


def _checkpoints(out: Path) -> list[Path]:
    return sorted((out / "checkpoints").glob("[!.]*.ckpt"))


def _remove(out: Path, checkpoints: Sequence[Path]) -> None:
    check_links(out)
    size = sum(path.stat().st_size for path in checkpoints)
    for path in checkpoints:
        path.unlink(missing_ok=True)
    if checkpoints:
        log.info("%s is finished and gave %.1f MB of checkpoints back: it can be measured again, not trained on "
                 "(keep_checkpoints=true)", out, size / 1e6)  # fmt: skip


def _description(out: Path) -> RunDescription | None:
    try:
        return RUN.find(out)
    except RecordError:
        return None


OF_PRUNING = (
    "callback.pruning.*",
    # What these lead to is compared where it acts.
    "schedule.removal_at",
    "schedule.removal_db",
    "sparsify.name",
    "sparsify.label",
    "sparsify.control",
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
    """Raise ValueError, naming the options, where a run would go on with another configuration than its own.

    From a checkpoint that was kept before a moment, another folder may prune otherwise from there on.
    """
    run, moment = run_of(start), checkpoint_fraction(start)
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


def start_from_trunk(cfg: DictConfig, out: Path) -> Path | None:
    """Return the latest checkpoint of ``trunk`` that this run can begin with; None where there is none.

    Of several processes each would look for itself, so a run that they share begins at step 0; ``resume=CHECKPOINT``
    names one for all.
    """
    first = first_pruning(config := flat_config(resolved(cfg)))
    if not cfg.trunk or cfg.overwrite or cfg.budget.minutes or math.isinf(first) or shares_a_run(cfg.trainer):
        return None
    run = Path(cfg.trunk)
    if run.absolute() == out.absolute() or not is_whole(run) or (trunk := configuration_of(run)) is None:
        return None
    kept = {checkpoint_fraction(path): path for path in (run / "checkpoints").glob("before_*.ckpt")}
    moment = max((one for one in kept if one is not None and one <= first), default=None)
    if moment is None or not is_branch(config, trunk, moment):
        return None
    log.info("begins with %s, with which it has all steps up to there in common", kept[moment])
    return kept[moment]
