"""The files beside a run's configuration: ``run.json`` says what made it, others why it failed or whence it came."""

import os
import platform
import subprocess
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from sparsestreet.records.configuration import Setting
from sparsestreet.records.file import JsonFile
from sparsestreet.records.strict_json import EXACT, version


@dataclass(frozen=True, kw_only=True)
class EffectDecision:
    """One effect that was asked for its reasons before training."""

    name: str
    on: bool
    source: str
    """Who decided: "declared" by the log's files, "measured" on its images, points or boxes, "probed" by two short
    trainings, "forced" by the configuration."""
    reason: str
    """One sentence, without a full stop."""
    value: float | None
    """What was declared, measured or counted; None: nothing."""
    unit: str
    """Of value, threshold and noise."""
    threshold: float | None
    """Value from which the effect is called for."""
    noise: float | None
    """Standard error of the value; None: unknown."""
    numbers: int
    """Predicted count of stored float32 numbers, if it is on."""
    ms: float
    """Predicted milliseconds of a frame, if it is on."""
    gain: float | None
    """Predicted gain in PSNR, dB; None: no prediction."""


RUN_FORMAT = 2
"""Version of ``run.json``; raised when a key changes its meaning."""


@dataclass(frozen=True)
class Noise:
    """How steady the machine was during a timing: a fixed loop before and after it, and who used the processors."""

    before: float
    """Ninth minus first decile of the loop's times, relative to their median."""
    after: float
    drift: float
    """Median after / median before - 1."""
    load_average: float | None
    """Average number of processes that wanted to run in the last minute; None if the system does not say."""
    quiet: bool
    """Whether spreads, drift and waits were small enough to trust medians to 5 % (``noise.QUIET_SPREAD``)."""
    waited: float | None = None
    """Part of the time in which the main thread was ready to run and had no processor; None: the record is older, or
    the system does not say."""
    others: float | None = None
    """Processors that other processes used meanwhile, on average."""


@dataclass(frozen=True)
class Machine:
    """The host that ran something."""

    processor: str
    cores: int
    system: str
    python: str
    torch: str


@dataclass(frozen=True)
class CodeVersion:
    """The version of the code that ran; both fields are None outside a git checkout."""

    commit: str | None
    dirty: bool | None
    """Whether tracked files differed from the commit."""


@dataclass(frozen=True, kw_only=True)
class RunDescription:
    """The content of ``run.json``: the identity of a run and how it was made. No evaluation changes it."""

    format: int = version(RUN_FORMAT, "train the run again")
    method: str
    """The method that is trained, such as "streetgs"."""
    sparsify: str
    """The sparsification, such as "paper"; "none" for a plain run."""
    label: str
    """The run's column in a table, such as "streetgs+paper"."""
    scene: str
    """Name of the log."""
    seed: int
    split: str
    """Which frames are held out, in words, such as "every 10th frame from 5"; "none"."""
    cameras: tuple[str, ...] = ()
    """Name and image size of each camera that is read, such as "CAM_FRONT 1600x900"; empty: the record is older."""
    config: dict[str, Setting] = field(metadata=EXACT)
    """The resolved configuration, flat: dotted key -> value."""
    follows: dict[str, Setting] = field(default_factory=dict, metadata=EXACT)
    """Option of ``config`` that grew with the number of training images -> what it is where nothing grows, which is
    the same for logs of all lengths; empty: none grew, or the record is older."""
    config_hash: str
    """``configuration.config_hash`` of ``config``; equal for repeats."""
    data_hash: str
    """``LogReader.data_hash``; equal for the same log in any folder."""
    masks: dict[str, str] = field(default_factory=dict)
    """Kind of masks ("sky", "human", "vehicle") -> whose they are (``types.MaskSource``), or "none"; empty: the record
    is older, or the log does not tell."""
    command: str
    """The command that trained."""
    device: str
    """The device that trained, such as "cuda: NVIDIA H100", or "cpu: " and the processor."""
    threads: int
    steps: int
    """Training steps taken; fewer than ``max_steps`` if the run was stopped."""
    max_steps: int
    training_seconds: float | None
    """Wall clock of training without evaluation; None if unknown."""
    noise: Noise | None
    """Noise during training; None if unknown."""
    caps: dict[str, int]
    """Name of each node that reached its ``max_gaussians`` at least once -> that limit."""
    held_back: dict[str, int] = field(default_factory=dict)
    """Name of each node that memory held down -> Gaussians that were not added, over all refinements."""
    rested: dict[str, int] = field(default_factory=dict)
    """Node and column, such as "background.means" -> how often a row of it took no step, since its gradient was not
    finite."""
    effects: tuple[EffectDecision, ...] = ()
    """The plan of effects, in the order in which they act on an image; empty: the record is older."""
    light: dict[str, float] = field(default_factory=dict)
    """How dark, noisy and clipped the images are (``evidence/light.py``); empty: the record is older."""
    machine: Machine
    source: CodeVersion


RUN = JsonFile("run.json", RunDescription)


@dataclass(frozen=True, kw_only=True)
class FailedRun:
    """A job that ended with an error."""

    format: int = version(1, "run the sweep again")
    label: str
    """The column that the run would have had in a table, such as "streetgs+paper"."""
    seed: int
    command: str
    """The command of this job alone."""
    error: str
    """The error, in a sentence."""
    trace: str
    """Python's traceback."""


FAILURE = JsonFile("failed.json", FailedRun)


def read_failures(sweep: Path) -> list[tuple[Path, FailedRun]]:
    """Return folder and failure of every failed job below a folder, sorted. Raises RecordError for a malformed one."""
    return [(run, FAILURE.read(run)) for run in FAILURE.runs(sweep)]


RIG_FORMAT = 1
"""Version of ``rig.json``; raised when a key changes its meaning."""

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True)
class RigRecord:
    """The content of ``rig.json``; runs of earlier versions have none."""

    format: int = version(RIG_FORMAT, "train the run again, or delete the file")
    camera_names: tuple[str, ...]
    """As the data set calls them, by camera index; empty: they have none but their indices."""
    dataset_from_world: Matrix = field(metadata=EXACT)
    """4x4: adds back what re-centering took away from the data set's own world."""
    world_from_vehicle: tuple[Matrix, ...] | None = field(metadata=EXACT)
    """4x4, x ahead, y left, z up, in the re-centered world; None: the log says nothing of the car."""
    vehicle_stamps: tuple[int, ...] | None
    """Nanoseconds on the log's clock, one a pose; None: the poses are those of the frames."""
    lidar: tuple[float, ...] | None = field(default=None, metadata=EXACT)
    """Where its main lidar stood once in the re-centered world, x, y, z, and the normalized time; None: not known."""

    def __post_init__(self) -> None:
        if self.lidar is not None and len(self.lidar) != 4:
            raise ValueError(f"the place of a lidar is x, y, z and a time, got {list(self.lidar)}")
        for matrix in (self.dataset_from_world, *(self.world_from_vehicle or ())):
            if len(matrix) != 4 or any(len(row) != 4 for row in matrix):
                raise ValueError(f"a pose is 4 x 4 numbers, got {matrix}")
        poses, stamps = self.world_from_vehicle, self.vehicle_stamps
        if stamps is not None and len(stamps) != len(poses or ()):
            raise ValueError(f"each pose has a stamp, got {len(poses or ())} poses and {len(stamps)} stamps")
        if poses is not None and not poses:
            raise ValueError("a vehicle has a pose, got none")


RIG = JsonFile("rig.json", RigRecord)


_PACKAGE = Path(__file__).resolve().parents[1]


def this_machine() -> Machine:
    """Return processor, cores and software versions; no host or user name."""
    return Machine(
        processor=processor_name(),
        cores=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        torch=metadata.version("torch"),
    )


def processor_name() -> str:
    """Return the processor's model, or its architecture if the system does not name a model."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def this_source(package: Path = _PACKAGE) -> CodeVersion:
    """Return the commit of the checkout that holds the package, and whether tracked files differ from it.

    Both are None if git is not installed or no checkout tracks the package. An installed copy inside another
    repository must not carry that repository's commit.
    """
    tracked = _git(package, "ls-files", "--error-unmatch", "__init__.py")
    commit = _git(package, "rev-parse", "HEAD")
    if tracked is None or commit is None:
        return CodeVersion(None, None)
    return CodeVersion(commit, _git(package, "status", "--porcelain", "--untracked-files=no") != "")


def _git(folder: Path, *arguments: str) -> str | None:
    """Return the output of a git command, or None if git is missing or fails."""
    try:
        answer = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    except (FileNotFoundError, subprocess.CalledProcessError):
        return None
    return answer.stdout.strip()
