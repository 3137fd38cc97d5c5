"""``RUN/run.json``: what identifies a run and what made it; training writes it once."""

from dataclasses import dataclass, field

from sparsestreet.records.configuration import Setting
from sparsestreet.records.effects import EffectDecision
from sparsestreet.records.file import JsonFile
from sparsestreet.records.strict_json import EXACT, version

RUN_FORMAT = 2
"""Version of ``run.json``; raised when a key changes its meaning."""


@dataclass(frozen=True)
class Noise:
    """How steady the machine was during a timing, measured by a fixed loop before and after it."""

    before: float
    """Ninth minus first decile of the loop's times, relative to their median."""
    after: float
    drift: float
    """Median after / median before - 1."""
    load_average: float | None
    """Average number of processes that wanted to run in the last minute; None if the system does not say."""
    quiet: bool
    """Whether spreads and drift were small enough to trust medians to 5 % (``noise.QUIET_SPREAD``)."""


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
    config_hash: str
    """``configuration.config_hash`` of ``config``; equal for repeats."""
    data_hash: str
    """``LogReader.data_hash``; equal for the same log in any folder."""
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
