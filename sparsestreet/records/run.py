"""``RUN/run.json``: what identifies a run and what made it; training writes it once."""

from dataclasses import dataclass, field

from sparsestreet.records.configuration import Setting
from sparsestreet.records.file import JsonFile
from sparsestreet.records.strict_json import EXACT, version

RUN_FORMAT = 2
"""Version of ``run.json``; raised when a key changes its meaning."""


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
class Machine:
    """The host something ran on."""

    processor: str
    cores: int
    system: str
    python: str
    torch: str


@dataclass(frozen=True)
class CodeVersion:
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
    source: CodeVersion


RUN = JsonFile("run.json", RunDescription)
