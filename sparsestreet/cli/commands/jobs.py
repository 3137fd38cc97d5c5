"""``sparsestreet jobs +sweep=NAME,...``: what sweeps would train, before anybody starts them."""

import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.table import Table

from sparsestreet.cli.config.compose import as_typed, configuration, resolved
from sparsestreet.cli.config.validate import SWEEPS, flags_of, override_problem
from sparsestreet.cli.runs.folder import first_pruning, identity_of_trunk, moments_to_keep
from sparsestreet.cli.runs.sweep import ALIKE, finished, jobs_of, with_fixed_keys
from sparsestreet.records.configuration import flat_config

USAGE = """\
sparsestreet jobs +sweep=NAME[,NAME ...] [key=value ...]
sparsestreet jobs -m key=value,value [key=value ...]

What sweeps of conf/sweep, or one of the command line, would train, with the options that train would get; nothing is
trained or written. A job that stands finished in its folder is not trained again. In a sweep that names a trunk
(conf/train.yaml), a job that differs from it only in what it prunes begins with its checkpoint (branch_points). So the
last column has what is trained in whole runs. Drives need not be there: data.root=a,b,c counts three, and
data.root=@FILE the folders that the lines of a file name.
"""


COMMAND_LINE = "-m"
"""What a sweep is called that no file of conf/sweep holds."""
_EVERY = 5.0
"""Seconds after which a line says how far the count is: a composition takes one of a busy machine."""
_OF_DRIVE = ("data.log.", "data.root", "seed")
"""Options that tell drives and seeds apart, or follow from them."""


def _sweep(name: str) -> list[str]:
    return [] if name == COMMAND_LINE else [f"+sweep={name}"]


@dataclass(frozen=True)
class SweepCount:
    """Jobs of a sweep, and those that stand finished.

    ``shared``: what the rest need not train because it begins with a checkpoint of its trunk, in whole runs.
    """

    name: str
    jobs: int
    finished: int
    shared: float = 0.0

    @property
    def trainings(self) -> int:
        return self.jobs - self.finished

    @property
    def whole_runs(self) -> float:
        return self.trainings - self.shared


def jobs(arguments: list[str]) -> int:
    """Print the counts; 2 on wrong usage."""
    arguments = as_typed(arguments)
    named = [name for text in arguments if text.startswith("+sweep=") for name in text[7:].split(",")]
    names = named or [COMMAND_LINE]
    if "--help" in arguments or not (named or SWEEPS & flags_of(arguments)):
        print(USAGE)
        return 0 if "--help" in arguments else 2
    rest = [text for text in arguments if not text.startswith("+sweep=") and text not in SWEEPS]
    problem = next(filter(None, (override_problem(["-m", *_sweep(name), *rest]) for name in names)), None)
    if problem:
        print(f"sparsestreet jobs: {problem}", file=sys.stderr)
        return 2
    try:
        Console().print(_table(count_jobs(names, rest)))
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        print(f"sparsestreet jobs: {str(error).splitlines()[0]}", file=sys.stderr)
        return 2
    return 0


def count_jobs(names: Sequence[str], overrides: Sequence[str]) -> list[SweepCount]:
    """The counts of each sweep, in their order. Raises what Hydra raises for options that do not compose."""
    counts = []
    with configuration():
        for name in names:
            before: dict[Path, _Job] = {}
            shared = 0.0
            for job in _jobs_of(with_fixed_keys(["-m", *_sweep(name), *overrides])[1:]):
                trunk = None if job.trunk is None else before.get(job.trunk)
                shared += 0.0 if job.done or trunk is None else job.begins(trunk)
                before[job.out] = job
            done = sum(job.done for job in before.values())
            counts.append(SweepCount(name, len(before), done, shared))
    return counts


@dataclass(frozen=True)
class _Job:
    out: Path
    prefix: tuple[object, ...]
    """What it trains before anything is pruned: what is the same on other drives and seeds, the log, the seed; empty
    where it follows from a run that is not there yet."""
    trunk: Path | None
    """The folder of the run that it would begin with."""
    first: float
    """The fraction of it at which something is pruned first."""
    keeps: tuple[float, ...]
    """The moments before which it leaves a checkpoint."""
    done: bool
    """Whether it stands finished in its folder."""

    def begins(self, trunk: "_Job") -> float:
        """Return the fraction of the run at which it begins."""
        kept = trunk.keeps if trunk.prefix == self.prefix != () else ()
        return max((moment for moment in kept if moment <= self.first < math.inf), default=0.0)


class JobComposer:
    """Composes jobs. Of those that differ in seed and drive alone the first is composed, the others put theirs in."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, ...], tuple[DictConfig, _Job]] = {}

    def job(self, words: Sequence[str], number: int) -> _Job:
        """Return the job of such overrides. Raises what Hydra raises for options that do not compose."""
        key = tuple(word for word in words if not word.startswith(ALIKE))
        if key in self._known and (job := self._like(*self._known[key], words, number)) is not None:
            return job
        cfg = compose("train", [*words, "folder=.", f"hydra.job.num={number}"], return_hydra_config=True)
        whole, out = cfg.copy(), Path(cfg.hydra.sweep.dir, cfg.hydra.sweep.subdir)
        with open_dict(cfg):
            del cfg["hydra"]
        cfg.folder = str(out)
        job = _job(cfg, out, done=out.is_dir() and finished(cfg, out) is not None)
        if job.prefix:
            self._known[key] = whole, job
        return job

    def _like(self, cfg: DictConfig, other: _Job, words: Sequence[str], number: int) -> _Job | None:
        """Return the job of a configuration with another seed and drive; None where its folder has to be looked at, or
        what it reads follows from files that are not there."""
        own = [OverridesParser.create().parse_override(word) for word in words if word.startswith(ALIKE)]
        for override in own:
            OmegaConf.update(cfg, override.key_or_group, override.value())
        cfg.hydra.job.num = number
        out = Path(cfg.hydra.sweep.dir, cfg.hydra.sweep.subdir)
        cfg.folder = str(out)
        try:
            read = OmegaConf.to_container(cfg.data.log, resolve=True)
        except (OmegaConfBaseException, ValueError):
            return None
        if out.is_dir():
            return None
        trunk = Path(os.path.normpath(cfg.trunk)) if cfg.trunk else None
        prefix = (other.prefix[0], str(read), cfg.seed)
        return replace(other, out=Path(os.path.normpath(out)), prefix=prefix, trunk=trunk, done=False)


def _jobs_of(overrides: Sequence[str]) -> Iterator[_Job]:
    words_of_jobs, composer = list(jobs_of(overrides)), JobComposer()
    said = time.monotonic()
    for number, words in enumerate(words_of_jobs):
        if time.monotonic() - said > _EVERY:
            said = time.monotonic()
            print(f"{number} of {len(words_of_jobs)} jobs looked at", file=sys.stderr, flush=True)
        yield composer.job(words, number)


def _job(cfg: DictConfig, out: Path, done: bool) -> _Job:
    try:
        config = flat_config(resolved(cfg))
        read, first = str(OmegaConf.to_container(cfg.data.log, resolve=True)), first_pruning(config)
    except (OmegaConfBaseException, ValueError):
        return _Job(out, (), None, 0.0, (), done)
    trunk = Path(os.path.normpath(cfg.trunk)) if cfg.trunk else None
    alike = identity_of_trunk({key: value for key, value in config.items() if not key.startswith(_OF_DRIVE)})
    return _Job(Path(os.path.normpath(out)), (alike, read, cfg.seed), trunk, first, moments_to_keep(cfg), done)


def _table(counts: Sequence[SweepCount]) -> Table:
    table = Table("sweep", box=None)
    for heading in ("jobs", "finished", "to train", "in whole runs"):
        table.add_column(heading, justify="right")
    parts = ("jobs", "finished", "shared")
    total = SweepCount("sum", *(sum(getattr(one, part) for one in counts) for part in parts))
    for one in [*counts, total] if len(counts) > 1 else counts:
        numbers = map(str, (one.jobs, one.finished, one.trainings))
        table.add_row(one.name, *numbers, f"{one.whole_runs:.1f}")
    return table
