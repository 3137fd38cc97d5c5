"""``sparsestreet jobs +sweep=NAME,...``: what sweeps would train, before anybody starts them."""

import sys
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hydra import compose
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.table import Table

from sparsestreet.cli.compose import configuration, override_problem, resolved
from sparsestreet.cli.folder import identity_of_run
from sparsestreet.cli.sweep import finished
from sparsestreet.records.configuration import flat_config

USAGE = """\
sparsestreet jobs +sweep=NAME[,NAME ...] [key=value ...]

What sweeps of conf/sweep would train, with the options that train would get; nothing is trained or written. A job
repeats another where its options, seed and drive are those of a job before it, in its own sweep or in one that is named
before: with reuse=true (conf/train.yaml) it is trained once. A job that stands finished in its folder is not trained
again either. Drives need not be there: data.root=a,b,c counts three.
"""


@dataclass(frozen=True)
class SweepCount:
    """Jobs of a sweep; those that repeat another, and of the others those that stand finished."""

    name: str
    jobs: int
    repeated: int
    finished: int

    @property
    def trainings(self) -> int:
        return self.jobs - self.repeated - self.finished


def jobs(arguments: list[str]) -> int:
    """Print the counts; 2 on wrong usage."""
    names = [name for text in arguments if text.startswith("+sweep=") for name in text[7:].split(",")]
    if not names or "--help" in arguments:
        print(USAGE)
        return 0 if "--help" in arguments else 2
    rest = [text for text in arguments if not text.startswith("+sweep=")]
    problem = next(filter(None, (override_problem(["-m", f"+sweep={name}", *rest]) for name in names)), None)
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
    seen: set[Hashable] = set()
    counts = []
    with configuration():
        for name in names:
            found = list(_jobs_of([f"+sweep={name}", *overrides]))
            new = {identity: done for identity, done in found if identity not in seen}
            seen |= new.keys()
            counts.append(SweepCount(name, len(found), len(found) - len(new), sum(new.values())))
    return counts


def _jobs_of(overrides: Sequence[str]) -> Iterator[tuple[Hashable, bool]]:
    """Of each job what it would train, and whether that stands finished in the job's folder."""
    given = [text for text in overrides if not _is_sweep(text)]
    params = compose("train", given, return_hydra_config=True).hydra.sweeper.params or {}
    asked = OverridesParser.create().parse_overrides([*(f"{key}={value}" for key, value in params.items()), *overrides])
    for batch in BasicSweeper.split_arguments(asked, max_batch_size=None):
        for words in batch:
            cfg = compose("train", [*words, "folder=."], return_hydra_config=True)
            out = Path(cfg.hydra.sweep.dir, cfg.hydra.sweep.subdir)
            with open_dict(cfg):
                del cfg["hydra"]
            cfg.folder = str(out)
            yield _identity(cfg, out), out.is_dir() and finished(cfg, out) is not None


def _identity(cfg: DictConfig, out: Path) -> Hashable:
    try:
        return identity_of_run(flat_config(resolved(cfg)))
    except (OmegaConfBaseException, ValueError):
        return out  # what it trains follows from a run that is not there yet


def _is_sweep(text: str) -> bool:
    return OverridesParser.create().parse_overrides([text])[0].is_sweep_override()


def _table(counts: Sequence[SweepCount]) -> Table:
    table = Table("sweep", box=None)
    for heading in ("jobs", "repeat another", "finished", "to train"):
        table.add_column(heading, justify="right")
    total = SweepCount("sum", *(sum(getattr(one, part) for one in counts) for part in ("jobs", "repeated", "finished")))
    for one in [*counts, total] if len(counts) > 1 else counts:
        table.add_row(one.name, *map(str, (one.jobs, one.repeated, one.finished, one.trainings)))
    return table
