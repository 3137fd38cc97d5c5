"""``sparsestreet jobs +sweep=NAME,...``: what sweeps would train and what that costs, before anybody starts them."""

import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.table import Table

from sparsestreet.cli.commands.options import parse_options
from sparsestreet.cli.config.compose import as_typed, configuration
from sparsestreet.cli.config.validate import SWEEPS, flags_of, override_problem
from sparsestreet.cli.runs.costs import Assumptions, MeasuredRun, cost_of, measured_runs
from sparsestreet.cli.runs.jobs import Job, dealt, jobs_of_sweep
from sparsestreet.cli.runs.sweep import with_fixed_keys

USAGE = """\
sparsestreet jobs +sweep=NAME[,NAME ...] [key=value ...] [measured=DIR] [devices=N]
                            [ms_per_step=N] [gaussians=N] [image=WIDTHxHEIGHT]
sparsestreet jobs -m key=value,value [key=value ...] [...]

What sweeps of conf/sweep, or one of the command line, would train, with the options that train would get; nothing is
trained or written. A job that stands finished in its folder is not trained again. In a sweep that names a trunk
(conf/train.yaml), a job that differs from it only in what it prunes begins with its checkpoint (branch_points): "whole
runs" counts so. Drives need not be there: data.root=a,b,c counts three, and data.root=@FILE the folders that the
lines of a file name.

Hours, memory and disk of the jobs that are left come from finished runs in the sweep's folder and in measured=DIR. A
run speaks for a job of its label, or else of its method with any sparsification; preset, capacity, reader, image size,
kind of device and limits of Gaussians must agree. Hours (means) are scaled by the steps that the job trains, memory is
the largest peak, disk what finished runs leave, without checkpoints. Where no run is like a job: hours are its steps at
ms_per_step=N alone; memory is the count that trainings check themselves by, of gaussians=N or the nodes' max_gaussians
on image=WIDTHxHEIGHT; disk is the scene of so many. A cell without a source for each job is "-", and a line says what
would fill it. "hours" are those of one device; with devices=N also the hours of the longest shard (train shard=K/N).
"""


COMMAND_LINE = "-m"
"""What a sweep is called that no file of conf/sweep holds."""
_MIN_WIDTH = 100
"""Letters of a line: no column is cut where a terminal has fewer."""
QUANTITIES = ("hours", "memory", "disk")


def _sweep(name: str) -> list[str]:
    return [] if name == COMMAND_LINE else [f"+sweep={name}"]


@dataclass(frozen=True)
class SweepCount:
    """Jobs of a sweep, those that stand finished, and what the rest costs; None: unknown of some job.

    ``shared``: what the rest need not train because it begins with a checkpoint of its trunk, in whole runs.
    """

    name: str
    jobs: int
    finished: int
    shared: float = 0.0
    hours: float | None = 0.0
    """Of one device."""
    longest: float | None = 0.0
    """Hours of the longest shard."""
    memory: float | None = 0.0
    """Bytes of the largest job."""
    disk: float | None = 0.0
    """Bytes of all."""
    sources: Counter[tuple[str, str]] = field(default_factory=Counter, compare=False)
    """Quantity and source -> number of jobs."""

    @property
    def trainings(self) -> int:
        return self.jobs - self.finished

    @property
    def whole_runs(self) -> float:
        return self.trainings - self.shared


def jobs(arguments: list[str]) -> int:
    """Print the counts; 2 on wrong usage."""
    own = {one.name for one in fields(Assumptions)}
    words = [text for text in arguments if text.partition("=")[0] in own]
    arguments = as_typed([text for text in arguments if text not in words])
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
        said = parse_options(words, Assumptions)
        counts = count_jobs(names, rest, said)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        print(f"sparsestreet jobs: {str(error).splitlines()[0]}", file=sys.stderr)
        return 2
    console = Console()
    console.print(_table(counts, said.devices), width=max(console.width, _MIN_WIDTH), crop=False)
    for line in _sources(counts):
        print(line)
    return 0


def count_jobs(names: Sequence[str], overrides: Sequence[str], said: Assumptions | None = None) -> list[SweepCount]:
    """Return the counts of each sweep, in their order.

    Raises what Hydra raises for options that do not compose, RecordError for a damaged record of a finished run.
    """
    said = said or Assumptions()
    counts = []
    with configuration():
        for name in names:
            found = {job.out: job for job in jobs_of_sweep(with_fixed_keys(["-m", *_sweep(name), *overrides])[1:])}
            folders = {job.out.parent for job in found.values()} | ({said.measured} if said.measured else set())
            runs = measured_runs(folder for folder in folders if folder.is_dir())
            counts.append(_count(name, list(found.values()), runs, said))
    return counts


def _count(name: str, jobs: Sequence[Job], runs: Sequence[MeasuredRun], said: Assumptions) -> SweepCount:
    """Return the count of a sweep with what its jobs cost."""
    before: dict[Path, Job] = {}
    shares, sources = {}, Counter()
    costs: dict[str, dict[Path, float | None]] = {quantity: {} for quantity in QUANTITIES}
    for job in jobs:
        trunk = None if job.trunk is None else before.get(job.trunk)
        before[job.out] = job
        if job.done:
            continue
        shares[job.out] = 0.0 if trunk is None else job.begins(trunk)
        for quantity, cost in cost_of(job.kind, 1 - shares[job.out], runs, said).items():
            costs[quantity][job.out] = cost.value
            sources[quantity, cost.source] += 1
    hours = costs["hours"]
    shards = [_total(hours.get(job.out, 0.0) for job in shard) for shard in dealt(jobs, said.devices)]
    return SweepCount(
        name,
        len(jobs),
        sum(job.done for job in jobs),
        sum(shares.values()),
        hours=_total(hours.values()),
        longest=_largest(shards),
        memory=_largest(costs["memory"].values()),
        disk=_total(costs["disk"].values()),
        sources=sources,
    )


def _total(values: Iterable[float | None]) -> float | None:
    known = list(values)
    return None if None in known else sum((value for value in known if value is not None), 0.0)


def _largest(values: Iterable[float | None]) -> float | None:
    known = list(values)
    return None if None in known else max((value for value in known if value is not None), default=0.0)


def _sum(counts: Sequence[SweepCount]) -> SweepCount:
    """Return the count of sweeps that are trained one after the other."""
    return SweepCount(
        "sum",
        *(sum(getattr(one, part) for one in counts) for part in ("jobs", "finished", "shared")),
        hours=_total(one.hours for one in counts),
        longest=_total(one.longest for one in counts),
        memory=_largest(one.memory for one in counts),
        disk=_total(one.disk for one in counts),
    )


def _table(counts: Sequence[SweepCount], devices: int) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("sweep", no_wrap=True)
    shards = [f"on {devices}\ndevices"] if devices > 1 else []
    for heading in ("jobs", "finished", "to\ntrain", "whole\nruns", "hours", *shards, "GB of\nmemory", "GB on\ndisk"):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in [*counts, _sum(counts)] if len(counts) > 1 else counts:
        numbers = map(str, (one.jobs, one.finished, one.trainings))
        hours = [one.hours, *([one.longest] if shards else ())]
        costs = [*hours, *(None if value is None else value / 1e9 for value in (one.memory, one.disk))]
        table.add_row(one.name, *numbers, f"{one.whole_runs:.1f}", *map(_cell, costs))
    return table


def _cell(value: float | None) -> str:
    """Return a number in three digits; "-" for one that is not known."""
    return "-" if value is None else f"{value:,.0f}" if value >= 99.95 else f"{value:.3g}"


def _sources(counts: Sequence[SweepCount]) -> list[str]:
    """Return a line for each source, with the quantities and the number of jobs that it speaks for."""
    found = sum((one.sources for one in counts), Counter())
    quantities: defaultdict[tuple[str, int], list[str]] = defaultdict(list)
    for (quantity, source), number in sorted(found.items(), key=lambda item: QUANTITIES.index(item[0][0])):
        quantities[source, number].append(quantity)
    return [f"{', '.join(names)} of {_jobs(number)}: {source}" for (source, number), names in quantities.items()]


def _jobs(count: int) -> str:
    return f"{count} job" if count == 1 else f"{count} jobs"
