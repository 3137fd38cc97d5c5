"""What identifies a run and what was measured of it, for other programs as for our report (no torch import).

``RUN/run.json`` is written once, by training: what made the run. ``RUN/records/summary.json`` is written by each
evaluation and holds the first unchanged. Both are written whole or not at all.
"""

from dataclasses import dataclass, field
from pathlib import Path

from sparsestreet.evaluation.configuration import Setting
from sparsestreet.evaluation.quality import MetricSummary
from sparsestreet.evaluation.strict_json import EXACT, read_json, version, write_json

RUN_FORMAT = 2
"""Version of ``run.json``; raised when a key changes its meaning."""

FORMAT = 4
"""Version of ``summary.json``; raised when a key changes its meaning."""

HELD_OUT, TRAINING = "held_out", "training"
"""The splits whose views a record speaks of."""


RASTER, FRAME, RIG = "raster", "frame", "rig"
"""What the clocks of a latency hold: the splat op alone; all from a time and a pose to uint8 on the device; that for
all cameras of an instant."""


@dataclass(frozen=True)
class Noise:
    """How steady the machine was while something was timed, by a fixed loop before and after it."""

    before: float
    """Ninth less first decile of the loop's times, relative to their median."""
    after: float
    drift: float
    """Median after / median before - 1."""
    load_average: float | None
    """Processes that wanted to run in the minute before; None where the system does not say."""
    quiet: bool
    """Whether spreads and drift were small enough for medians to be trusted to 5 % (``noise.QUIET_SPREAD``)."""


@dataclass(frozen=True)
class Percentiles:
    """Of repeated times, milliseconds."""

    p50: float
    p90: float
    p99: float
    repeats: int


@dataclass(frozen=True)
class Latency:
    """Milliseconds by three clocks under the protocol of ``speed.measure_latency``."""

    clocks: dict[str, Percentiles]
    """``RASTER``, ``FRAME`` and ``RIG`` of the scene as it is stored; Gaussians that a mask closes are masked."""
    removed: dict[str, Percentiles]
    """The same with the Gaussians taken out that the masks close at the time of the view; empty without masks."""
    warmup: int
    views: int
    """Number of different views the repeats cycle through."""
    device: str
    threads: int
    noise: Noise

    def __post_init__(self) -> None:
        if set(self.clocks) != {RASTER, FRAME, RIG} or set(self.removed) not in (set(), set(self.clocks)):
            raise ValueError(
                f"a latency has the clocks {RASTER}, {FRAME}, {RIG}, got {sorted(self.clocks)} and, of removed "
                f"Gaussians, {sorted(self.removed)}: evaluate again"
            )

    @property
    def p50(self) -> float:
        """Median of a frame."""
        return self.clocks[FRAME].p50

    @property
    def protocol(self) -> str:
        """How the median of a frame was taken, in words."""
        return (
            f"{self.clocks[FRAME].repeats} renders cycling through {self.views} views after {self.warmup} warm-up "
            "renders, batch 1, device synchronized, scene assembly to uint8, without loading and metrics"
        )


@dataclass(frozen=True)
class Machine:
    """The host something ran on."""

    processor: str
    cores: int
    system: str
    python: str
    torch: str


@dataclass(frozen=True)
class Source:
    """Which code ran; None outside a git checkout."""

    commit: str | None
    dirty: bool | None
    """Whether tracked files differed from the commit."""


@dataclass(frozen=True, kw_only=True)
class RunDescription:
    """The content of ``run.json``: what identifies a run and what made it. No evaluation changes it."""

    format: int = version(RUN_FORMAT, "train the run again")
    method: str
    """Which scene is trained, such as "streetgs"."""
    sparsify: str
    """What makes it small, such as "paper"; "none" for a plain run."""
    label: str
    """The run's column in a table, such as "streetgs+paper"."""
    scene: str
    """Name of the log."""
    seed: int
    split: str
    """Which frames are held out, in words, such as "every 10th frame from 5"; "none"."""
    config: dict[str, Setting] = field(metadata=EXACT)
    """The resolved configuration, flat: dotted key -> value."""
    config_hash: str
    """``configuration.config_hash`` of it: equal for repeats."""
    data_hash: str
    """``LogReader.data_hash``: equal for the same log, wherever it lies."""
    command: str
    """The command that trained."""
    device: str
    """What trained, such as "cuda: NVIDIA H100" or "cpu: " and the processor."""
    threads: int
    steps: int
    """Training steps taken; fewer than ``max_steps`` where the run was stopped."""
    max_steps: int
    training_seconds: float | None
    """Wall clock of training without evaluation; None where it is not known."""
    noise: Noise | None
    """While it trained; None where that is not known."""
    caps: dict[str, int]
    """Nodes whose number of Gaussians was held down by their ``max_gaussians`` at least once -> that limit."""
    machine: Machine
    source: Source


@dataclass(frozen=True)
class Evaluation:
    """What measured a run."""

    command: str
    machine: Machine
    source: Source
    device: str
    threads: int


@dataclass(frozen=True)
class GuardCounts:
    """How many Gaussians the guards of the splat op acted on (``sparsestreet.ops.Guards``), summed over views."""

    rows: dict[str, int]
    """Name of a guard -> Gaussians, 0 included."""
    alarms: dict[str, int]
    """Those that a clean scene never needs and that acted; empty where all is well."""

    def __post_init__(self) -> None:
        for name, count in self.alarms.items():
            if count < 1 or self.rows.get(name) != count:
                raise ValueError(f"alarms holds {name}: {count}, rows has {self.rows.get(name)}: evaluate again")


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The content of ``summary.json``."""

    format: int = version(FORMAT, "evaluate again")
    run: RunDescription
    evaluated: Evaluation
    images: dict[str, int]
    """Split ("held_out", "training") -> number of its images that were evaluated; a split without views is absent."""
    resolutions: tuple[str, ...]
    """"WIDTHxHEIGHT" of the evaluated images, each once."""
    quality: dict[str, dict[str, MetricSummary]]
    """Split -> id of a metric -> its summary over the split's images."""
    by_camera: dict[str, dict[str, dict[str, float | None]]]
    """Split -> number of a camera -> id of a metric -> its mean over the split's images of that camera."""
    definitions: dict[str, str]
    """Id of a metric -> what it is, in words."""
    gaussians: dict[str, int]
    """Node -> Gaussians, all instances, visible or not."""
    gaussians_total: int
    bytes_by_part: dict[str, int]
    bytes_total: int
    latency: Latency
    """Over the views of ``main_split``, on the device it names."""
    latency_protocol: str
    guards: GuardCounts
    """Over the views of ``main_split``."""

    def __post_init__(self) -> None:
        splits = [sorted(part) for part in (self.quality, self.by_camera, self.images)]
        if splits[0] not in ([HELD_OUT], [TRAINING], [HELD_OUT, TRAINING]) or splits != 3 * splits[:1]:
            raise ValueError(
                f"quality speaks of the splits {splits[0]}, by_camera of {splits[1]} and images of {splits[2]}, "
                f"expected {HELD_OUT}, {TRAINING} or both in all: evaluate again"
            )
        for name, parts, total in (
            ("gaussians", self.gaussians, self.gaussians_total),
            ("bytes", self.bytes_by_part, self.bytes_total),
        ):
            if sum(parts.values()) != total:
                raise ValueError(f"{name}_total is {total}, its parts sum to {sum(parts.values())}: {parts}")

    @property
    def main_split(self) -> str:
        """The held-out views, or the training views of a run that holds out none."""
        return HELD_OUT if HELD_OUT in self.quality else TRAINING

    def mean(self, metric: str, split: str | None = None) -> float | None:
        """Mean of a metric over the images of a split (of ``main_split``); None where it was not measured."""
        found = self.quality.get(split or self.main_split, {}).get(metric)
        return None if found is None else found.mean

    def camera_mean(self, metric: str, camera: str) -> float | None:
        """Mean of a metric over the images of one camera of ``main_split``; None where it was not measured."""
        return self.by_camera[self.main_split].get(camera, {}).get(metric)


def run_path(run: Path) -> Path:
    """Where a run says what it is."""
    return run / "run.json"


def write_run(path: Path, run: RunDescription) -> None:
    """Write ``run.json`` atomically. Raises RecordError for values that JSON has no number for."""
    write_json(path, run)


def read_run(path: Path) -> RunDescription:
    """Read ``run.json``. Raises RecordError naming the file and the entry that is wrong."""
    return read_json(path, RunDescription)


def summary_path(run: Path) -> Path:
    """Where a run keeps its summary."""
    return run / "records" / "summary.json"


def write_summary(path: Path, summary: RunSummary) -> None:
    """Write ``summary.json`` atomically. Raises RecordError for values that JSON has no number for."""
    write_json(path, summary)


def read_summary(path: Path) -> RunSummary:
    """Read ``summary.json``. Raises RecordError naming the file and the entry that is wrong."""
    return read_json(path, RunSummary)
