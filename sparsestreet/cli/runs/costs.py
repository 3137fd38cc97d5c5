"""What the jobs of a sweep will cost in device hours, memory and disk: measured on runs like them, or counted."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sparsestreet.cli.config.compose import with_images
from sparsestreet.records.configuration import Configuration, Setting
from sparsestreet.records.costs import COSTS
from sparsestreet.records.run import RUN

LIKE = (
    *("method.name", "preset.name", "capacity.name", "trainer.accelerator", "trainer.strategy._target_"),
    *("data.log._target_", "data.log.width", "data.log.settings.width", "data.log.settings.height"),
)
"""Options in which a measured run must agree with a job, beside limits of Gaussians."""
_TRAINS = ("train", "validate", "save")
"""Phases of a run that take as long as it has steps; the others come once."""
_WIDTHS = {"velocities": 3, "life_peaks": 1, "log_life_spans": 1}
"""Numbers that a Gaussian of a vibrating node has beside those of every other."""
OF_ANOTHER_RUN = "of another run"
"""Stands for a value that follows from a run that is counted (``count_of``)."""
_MANY = 10**6
"""Training images of a log on which all depends that grows with the log."""


@dataclass(frozen=True)
class Kind:
    """What of a job's configuration decides its cost."""

    label: str
    like: tuple[Setting, ...]
    """The values of ``LIKE``."""
    steps: int | None
    """None: they follow from the log, or from a budget of minutes."""
    limits: tuple[tuple[str, int], ...]
    """Node -> ``max_gaussians``, of the nodes of which the configuration alone says it."""
    unlimited: tuple[str, ...]
    """Nodes whose number of Gaussians nothing limits, or a limit that follows from the log or another run."""
    row_bytes: int
    """Bytes of the columns of a Gaussian, without those of masks."""
    moved: bool
    """Whether some steps render a second view."""
    size: tuple[int, int] | None
    """Width and height of an image in px; None: the log says it."""
    limits_of: Callable[[int | None], Mapping[str, Setting]] = field(compare=False)
    """Training images of a log -> node -> ``max_gaussians`` that the job would have there."""


def kind_of(cfg: DictConfig) -> Kind:
    """Return the kind of a job; what follows from a run that is not there yet counts as unknown."""
    fixed = _fixed_value(cfg)
    limits = {name: fixed(f"node.{name}.max_gaussians") for name in cfg.node or ()}
    width, height = (fixed(f"data.log.settings.{side}") for side in ("width", "height"))
    degree = max((fixed(f"node.{name}.sh_degree") or 0 for name in limits), default=0)
    rates = {column for name in limits for column in OmegaConf.select(cfg, f"node.{name}.learning_rates") or ()}
    numbers = 11 + 3 * (degree + 1) ** 2 + sum(count for column, count in _WIDTHS.items() if column in rates)
    return Kind(
        label=str(fixed("name")),
        like=tuple(map(fixed, LIKE)),
        steps=None if fixed("budget.minutes") else fixed("schedule.max_steps"),
        limits=tuple((name, limit) for name, limit in limits.items() if limit is not None),
        unlimited=tuple(name for name, limit in limits.items() if limit is None),
        row_bytes=4 * numbers,
        moved=cfg.moved_views is not None,
        size=(width, height) if width and height else None,
        limits_of=_limits_of(cfg),
    )


def _fixed_value(cfg: DictConfig) -> Callable[[str], Any]:
    """Return what reads a value: None where it grows with the log, or cannot be known yet."""
    known = with_images(cfg, _MANY)

    def value(key: str) -> Any:
        found = _selected(cfg, key)
        return None if found == OF_ANOTHER_RUN or found != _selected(known, key) else found

    return value


def _limits_of(cfg: DictConfig) -> Callable[[int | None], Mapping[str, Setting]]:
    """Return what tells ``max_gaussians`` of each node by the number of training images."""
    uncounted = cfg.copy()
    uncounted.count_of = None

    @cache
    def limits(images: int | None) -> Mapping[str, Setting]:
        own, free = with_images(cfg, images), with_images(uncounted, images)
        found = {name: _selected(own, f"node.{name}.max_gaussians") for name in cfg.node or ()}
        alike = {name for name, limit in found.items() if limit == _selected(free, f"node.{name}.max_gaussians")}
        return {name: limit if name in alike else OF_ANOTHER_RUN for name, limit in found.items()}

    return limits


def _selected(cfg: DictConfig, key: str) -> Any:
    try:
        return OmegaConf.select(cfg, key)
    except (OmegaConfBaseException, ValueError):
        return OF_ANOTHER_RUN


@dataclass(frozen=True)
class MeasuredRun:
    """What a finished run took, all of its own steps counted: a branch knows those of its trunk too."""

    config: Configuration
    device: str
    steps: int
    seconds: float
    """Of the whole command."""
    training: float
    """Seconds of ``seconds`` that grow with the steps."""
    memory: float
    """Bytes at its peak: of the GPU, on a CPU of the process."""
    disk: int
    """Bytes of its folder without checkpoints."""

    def hours(self, steps: int | None, share: float) -> float:
        """Return the hours of a run of so many steps, of which a share is trained; None: as many steps as this one."""
        scale = 1.0 if steps is None else steps / self.steps
        return (self.seconds - self.training + self.training * scale * share) / 3600

    def is_like(self, kind: Kind) -> bool:
        """Return whether the run has the method, preset, size and device of a job, and the limits that it would have on
        this log."""
        if tuple(self.config.get(key) for key in LIKE) != kind.like:
            return False
        limits = kind.limits_of(cast(int | None, self.config.get("training_views.images")))
        own = {name: self.config.get(f"node.{name}.max_gaussians") for name in limits}
        return all(limit in (own[name], OF_ANOTHER_RUN) for name, limit in limits.items())


def measured_runs(folders: Iterable[Path]) -> list[MeasuredRun]:
    """Return the finished runs below these folders, each once. Raises RecordError for a damaged record."""
    found = {run.resolve(): run for folder in folders for run in COSTS.runs(folder)}
    return [one for run in found.values() if (one := _measured(run)) is not None]


def _measured(run: Path) -> MeasuredRun | None:
    costs, said = COSTS.read(run), RUN.find(run)
    memory = costs.peak_device_mb or costs.peak_host_mb
    if costs.wall_seconds is None or memory is None or said is None or said.steps < said.max_steps:
        return None
    files = [path for path in run.rglob("*") if path.is_file() and "checkpoints" not in path.relative_to(run).parts]
    return MeasuredRun(
        config=said.config,
        device=said.device,
        steps=said.steps,
        seconds=costs.wall_seconds,
        training=sum(costs.phases.get(phase, 0.0) for phase in _TRAINS),
        memory=1e6 * memory,
        disk=sum(path.stat().st_size for path in files),
    )


@dataclass(frozen=True)
class Assumptions:
    """What the user says where nothing was measured. Raises ValueError for numbers that cannot be."""

    measured: Path | None = None
    """A folder of finished runs."""
    ms_per_step: float | None = None
    gaussians: int | None = None
    """Of a scene at its largest."""
    image: str | None = None
    """WIDTHxHEIGHT of the largest image, px."""
    devices: int = 1

    def __post_init__(self) -> None:
        for name in ("ms_per_step", "gaussians", "devices"):
            if (value := getattr(self, name)) is not None and not value > 0:
                raise ValueError(f"{name} must be above 0, got {value}")
        if self.image is not None and not re.fullmatch(r"[1-9]\d*x[1-9]\d*", self.image):
            raise ValueError(f"image must be WIDTHxHEIGHT, such as 960x640, got {self.image!r}")
        if self.measured is not None and not self.measured.is_dir():
            raise ValueError(f"measured={self.measured} is no folder: name one of finished runs")

    def size(self, kind: Kind) -> tuple[int, int] | None:
        """Return width and height of a job's largest image in px; None where nobody says it."""
        return kind.size if self.image is None else tuple(map(int, self.image.split("x")))  # pyright: ignore[reportReturnType]

    def rows(self, kind: Kind) -> int | None:
        """Return a job's Gaussians at its largest; None where neither the user nor limits say it."""
        return self.gaussians or (None if kind.unlimited else sum(limit for _, limit in kind.limits))


@dataclass(frozen=True)
class Cost:
    """A number that a job will take, and where it comes from; None: nothing tells, and the source says what would."""

    value: float | None
    source: str


def cost_of(kind: Kind, share: float, runs: Sequence[MeasuredRun], said: Assumptions) -> Mapping[str, Cost]:
    """Return what a job will take: "hours" of a device, bytes of "memory" at its peak, bytes on "disk" at its end.

    Runs of its label come first, then runs of its method with any sparsification; then what is counted.

    Args:
        kind: of the job.
        share: of its steps that it trains; the others are its trunk's.
        runs: finished ones.
        said: what the user assumes.
    """
    like = [run for run in runs if run.is_like(kind)]
    near = [run for run in like if run.config.get("name") == kind.label] or like
    if not near:
        return _counted(kind, share, said)
    of = "its label" if near[0].config.get("name") == kind.label else "its method"
    source = f"measured on finished runs of {of} ({', '.join(sorted({run.device for run in near}))})"
    return {
        "hours": Cost(fmean(run.hours(kind.steps, share) for run in near), source),
        "memory": Cost(max(run.memory for run in near), source),
        "disk": Cost(fmean(run.disk for run in near), source),
    }


def _counted(kind: Kind, share: float, said: Assumptions) -> Mapping[str, Cost]:
    """Return what follows from the user's numbers, limits of Gaussians and the sizes of columns."""
    steps, rows, size, pace = kind.steps, said.rows(kind), said.size(kind), said.ms_per_step
    hours = None if pace is None or steps is None else steps * share * pace / 3.6e6
    disk = None if rows is None else float(rows * kind.row_bytes)
    memory = None if rows is None or size is None else _step_bytes(kind, rows, size)
    of = f"{rows or 0:,} Gaussians of {kind.row_bytes // 4} numbers"
    hours_from = {"ms_per_step=N": pace, "schedule.max_steps=N": steps}
    rows_from = {"gaussians=N": rows}
    return {
        "hours": Cost(hours, _source(hours, f"of their steps alone, at {pace or 0:g} ms", hours_from)),
        "memory": Cost(memory, _source(memory, f"counted, {of}", rows_from | {"image=WIDTHxHEIGHT": size})),
        "disk": Cost(disk, _source(disk, f"counted, a scene of {of}", rows_from)),
    }


def _step_bytes(kind: Kind, rows: int, size: tuple[int, int]) -> float:
    from sparsestreet.training.forecast import foreseen_bytes  # torch

    return foreseen_bytes(rows, float(kind.row_bytes), size[0] * size[1], moved=kind.moved)


def _source(value: float | None, known: str, needed: Mapping[str, object]) -> str:
    if value is not None:
        return known
    absent = [word for word, found in needed.items() if found is None]
    return f"unknown, as no finished run is like them: give measured=DIR, or {' with '.join(absent)}"
