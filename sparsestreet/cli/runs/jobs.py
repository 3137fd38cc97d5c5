"""The jobs of a sweep: where each writes, which run it begins with, and how they are dealt into shards."""

import math
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from sparsestreet.cli.config.compose import configuration, is_sweep, quoted, resolved, without_flags
from sparsestreet.cli.runs.costs import Kind, kind_of
from sparsestreet.cli.runs.folder import (
    first_pruning,
    give_back_trunk,
    identity_of_trunk,
    is_whole,
    moments_to_keep,
)
from sparsestreet.cli.runs.sweep import ALIKE, SweepFolder, finished, has_known_jobs, jobs_of
from sparsestreet.naming import kept_before
from sparsestreet.records.configuration import flat_config

_EVERY = 5.0
"""Seconds after which a line says how far the count is: a composition takes one of a busy machine."""
_SHARD = "shard="
_OF_DRIVE = ("data.log.", "data.root", "seed")
"""Options that tell drives and seeds apart, or follow from them."""


@dataclass(frozen=True)
class Job:
    """A job of a sweep, before it is trained."""

    words: tuple[str, ...]
    """Its overrides, as Hydra would give them to it."""
    out: Path
    within: str
    """``out``, as it stands below the sweep's folder."""
    prefix: tuple[object, ...]
    """What it trains before anything is pruned: what is the same on other drives and seeds, the log, the seed; empty
    where it follows from a run that is not there yet."""
    trunk: Path | None
    """The folder of the run that it would begin with."""
    counted: Path | None
    """The folder of the run that it has its number of Gaussians from."""
    first: float
    """The fraction of it at which something is pruned first."""
    keeps: tuple[float, ...]
    """The moments before which it leaves a checkpoint."""
    kept: bool
    """Whether it keeps its checkpoints for good."""
    done: bool
    """Whether it stands finished in its folder."""
    kind: Kind

    def begins(self, trunk: "Job") -> float:
        """Return the fraction of the run at which it begins.

        A trunk that stands finished may have given its checkpoints back: those that are there count.
        """
        kept = trunk.keeps if trunk.prefix == self.prefix != () else ()
        if trunk.done:
            kept = tuple(moment for moment in kept if (trunk.out / "checkpoints" / kept_before(moment)).is_file())
        return max((moment for moment in kept if moment <= self.first < math.inf), default=0.0)


class JobComposer:
    """Composes jobs. Of those that differ in seed and drive alone the first is composed, the others put theirs in.

    ``looks``: whether folders are looked at, for jobs that stand finished; else all count as not yet trained.
    """

    def __init__(self, looks: bool = True) -> None:
        self.looks = looks
        self._known: dict[tuple[str, ...], tuple[DictConfig, Job]] = {}

    def job(self, words: Sequence[str], number: int) -> Job:
        """Return the job of such overrides. Raises what Hydra raises for options that do not compose."""
        key = tuple(word for word in words if not word.startswith(ALIKE))
        if key in self._known and (job := self._like(*self._known[key], words, number)) is not None:
            return job
        cfg = compose("train", [*words, "folder=.", f"hydra.job.num={number}"], return_hydra_config=True)
        whole, sweep = cfg.copy(), cfg.hydra.sweep
        out, within = Path(sweep.dir, sweep.subdir), str(sweep.subdir)
        with open_dict(cfg):
            del cfg["hydra"]
        cfg.folder = str(out)
        done = self.looks and out.is_dir() and finished(cfg, out) is not None
        job = _job(cfg, words, out, within, done=done)
        if job.prefix:
            self._known[key] = whole, job
        return job

    def _like(self, cfg: DictConfig, other: Job, words: Sequence[str], number: int) -> Job | None:
        """Return the job of a configuration with another seed and drive; None where its folder has to be looked at, or
        what it reads follows from files that are not there."""
        own = [OverridesParser.create().parse_override(word) for word in words if word.startswith(ALIKE)]
        for override in own:
            OmegaConf.update(cfg, override.key_or_group, override.value())
        cfg.hydra.job.num = number
        within = str(cfg.hydra.sweep.subdir)
        out = Path(cfg.hydra.sweep.dir, within)
        cfg.folder = str(out)
        try:
            read = OmegaConf.to_container(cfg.data.log, resolve=True)
        except (OmegaConfBaseException, ValueError):
            return None
        if self.looks and out.is_dir():
            return None
        places = {"out": _folder(out), "trunk": _folder(cfg.trunk), "counted": _folder(cfg.count_of)}
        prefix = (other.prefix[0], str(read), cfg.seed)
        return replace(other, words=tuple(words), within=within, prefix=prefix, done=False, **places)


def jobs_of_sweep(overrides: Sequence[str], looks: bool = True) -> Iterator[Job]:
    """Yield the jobs of a sweep in Hydra's order; a line on standard error says how far it is where that takes long.

    ``looks``: as in ``JobComposer``. Raises what Hydra raises for options that do not compose.
    """
    words_of_jobs, composer = list(jobs_of(overrides)), JobComposer(looks)
    said = time.monotonic()
    for number, words in enumerate(words_of_jobs):
        if time.monotonic() - said > _EVERY:
            said = time.monotonic()
            print(f"{number} of {len(words_of_jobs)} jobs looked at", file=sys.stderr, flush=True)
        yield composer.job(words, number)


def _job(cfg: DictConfig, words: Sequence[str], out: Path, within: str, done: bool) -> Job:
    job = Job(
        words=tuple(words),
        out=Path(os.path.normpath(out)),
        within=within,
        prefix=(),
        trunk=_folder(cfg.trunk),
        counted=_folder(cfg.count_of),
        first=0.0,
        keeps=(),
        kept=cfg.keep_checkpoints,
        done=done,
        kind=kind_of(cfg),
    )
    try:
        config = flat_config(resolved(cfg))
        read, first = str(OmegaConf.to_container(cfg.data.log, resolve=True)), first_pruning(config)
    except (OmegaConfBaseException, ValueError):
        return job
    alike = identity_of_trunk({key: value for key, value in config.items() if not key.startswith(_OF_DRIVE)})
    return replace(job, prefix=(alike, read, cfg.seed), first=first, keeps=moments_to_keep(cfg))


def _folder(path: Any) -> Path | None:
    return Path(os.path.normpath(path)) if path else None


@dataclass(frozen=True)
class Shard:
    """The ``number``-th of ``count`` shards of a sweep, from 1 on. Raises ValueError for one that is none."""

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise ValueError(f"shard={self.number}/{self.count} is none: give shard=K/N with 1 <= K <= N")

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Return the shard of a word such as "3/16". Raises ValueError for another word."""
        found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
        if found is None:
            raise ValueError(f"shard={text} is none: give shard=K/N, such as shard=3/16")
        return cls(int(found[1]), int(found[2]))


def dealt(jobs: Sequence[Job], count: int) -> list[list[Job]]:
    """Return the jobs of each of ``count`` shards, in their order.

    Jobs that need each other (trunk, ``count_of``) are in one shard. Groups are dealt by the number of their first job,
    whatever is finished, so that every shard knows the same.
    """
    leader = {job.out: number for number, job in enumerate(jobs)}
    for job in jobs:
        needed = (job.out, job.trunk, job.counted)
        group = {leader[path] for path in needed if path is not None and path in leader}
        if len(group) > 1:
            leader = {path: min(group) if first in group else first for path, first in leader.items()}
    place = {first: index % count for index, first in enumerate(sorted(set(leader.values())))}
    shards: list[list[Job]] = [[] for _ in range(count)]
    for job in jobs:
        shards[place[leader[job.out]]].append(job)
    return shards


def without_shard(arguments: list[str]) -> tuple[Shard | None, list[str]]:
    """Return what ``shard=K/N`` asks for, and the other arguments. Raises ValueError for a word that is none."""
    said = [text for text in arguments if text.startswith(_SHARD)]
    shard = Shard.parse(said[-1].removeprefix(_SHARD)) if said else None
    return shard, [text for text in arguments if text not in said]


def shard_problem(shard: Shard | None, arguments: list[str]) -> str | None:
    """Return in one line why these arguments have no shards; None where none is asked for, or they have."""
    if shard is None:
        return None
    if not has_known_jobs(arguments):
        return "shard=K/N takes jobs of a sweep whose jobs are known: name a sweep, without a sweeper of your own"
    if any(text.startswith(("hydra/launcher=", "hydra.launcher.")) for text in arguments):
        return "a shard trains its jobs one after the other: leave out the launcher, or shard=K/N"
    with configuration():
        given = [text for text in without_flags(arguments) if not is_sweep(text)]
        cfg: Any = OmegaConf.to_container(compose("train", given, return_hydra_config=True).hydra)
        if "${now:" in cfg["sweep"]["dir"]:
            return "shards write into one folder, and this sweep names a new one: give hydra.sweep.dir=DIR"
    return None


def jobs_of_shard(shard: Shard, arguments: list[str]) -> list[Job]:
    """Return the jobs of a shard of the sweep that the arguments name, and say how many they are."""
    with configuration():
        jobs = list(jobs_of_sweep(without_flags(arguments), looks=False))
    own = dealt(jobs, shard.count)[shard.number - 1]
    said = f"sparsestreet train: shard {shard.number} of {shard.count} has {len(own)} of {len(jobs)} jobs"
    print(said, file=sys.stderr, flush=True)
    return own


def words_of_job(job: Job) -> list[str]:
    """Return the arguments of a sweep of this one job, into the folder that it has in the whole sweep."""
    return ["-m", *job.words, f"hydra.sweep.subdir={quoted(job.within)}"]


def give_back_trunks(arguments: list[str], own: Sequence[Job] | None) -> None:
    """Remove the checkpoints of trunks all of whose branches stand finished.

    Args:
        arguments: of the sweep; any others are none, and nothing happens.
        own: the jobs of a shard; None: those of the whole sweep.
    """
    if SweepFolder.folder is None or not has_known_jobs(arguments):
        return
    words = without_flags(arguments)
    with configuration():
        cfg: Any = OmegaConf.to_container(compose("train", [text for text in words if not is_sweep(text)]))
        if not cfg["trunk"]:
            return
        # A folder that is named by the clock is that of this sweep.
        place = f"hydra.sweep.dir={quoted(str(SweepFolder.folder))}"
        own = list(jobs_of_sweep([*words, place], looks=False)) if own is None else own
    for trunk in trunks_done(own):
        give_back_trunk(trunk)


def trunks_done(jobs: Sequence[Job]) -> list[Path]:
    """Return the folders of trunks that stand finished with every branch among the jobs, and keep no checkpoints."""
    branches: dict[Path, list[Job]] = {}
    for job in jobs:
        if job.trunk is not None:
            branches.setdefault(job.trunk, []).append(job)
    own = {job.out: job for job in jobs}
    return [
        trunk
        for trunk, found in branches.items()
        if trunk in own and not own[trunk].kept and all(is_whole(job.out) for job in (own[trunk], *found))
    ]
