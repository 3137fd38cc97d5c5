"""``records/cost.json``: how a run spent its time and memory.

Training and evaluation each write their own part and keep the other's.
"""

import statistics
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from sparsestreet.records.file import JsonFile, table_of
from sparsestreet.records.run import Noise
from sparsestreet.records.strict_json import version


@dataclass(frozen=True)
class StepPhase:
    """A part of a step that was timed."""

    step: int
    phase: str
    milliseconds: float


STEP_PHASES = table_of("records/phases.csv", StepPhase, "train the run", milliseconds=".4f")


FORMAT = 1
"""Version of ``cost.json``; raised when a key changes its meaning."""

PRUNE = "prune"
"""Name of the stage of pruning; each pass is a detail of this stage."""

_BELONGS = 0.02
"""Largest share of the wall clock that may lie in no phase."""

_PARTS = {
    **dict.fromkeys(("splat backward", "scene backward", "sky backward", "ssim backward"), "backward"),
    "density statistics": "density",
    "logging": "loop",
}


@dataclass(frozen=True)
class NodeCost:
    """What a node class costs in a scene."""

    gaussians: int
    megabytes: float
    """Size of its rows and poses, 10^6 bytes."""
    frame_ms: float
    """Median milliseconds of a frame without the node."""
    ms: float
    """Additional milliseconds of a frame with the node: the median over pairs of frames, with and without it. Noise
    can make it negative. Nodes that hide each other cost less together than the sum of both."""


@dataclass(frozen=True)
class EffectGain:
    """PSNR of renders with an effect less that of the same renders without it, dB: the mean over the images.

    The scene was trained with the effect, so this is what it does in the finished scene; a scene that was trained
    without it would have made up for a part.
    """

    full: float
    vehicle: float | None
    """On the pixels of vehicles; None: no image shows one."""
    human: float | None
    images: int


@dataclass(frozen=True, kw_only=True)
class CostRecord:
    """The content of ``cost.json``. Raises ValueError if the phases do not add up to the wall clock."""

    format: int = version(FORMAT, "train the run again")
    wall_seconds: float | None = None
    """Seconds of the whole ``train`` command and of the interrupted commands that it continued. They include torch's
    import, but not the interpreter's own start (0.2 s). None until a command has ended."""
    phases: dict[str, float]
    """Part of the command (start, data, effects, points, initialize, train, validate, prune, save, evaluate, latency,
    costs, gains, novel, presets, pictures, other) -> seconds. Each second belongs to one part."""
    step_ms: dict[str, float]
    """Part of a training step -> median milliseconds over the noted steps that have it; empty if no step was noted."""
    passes: dict[str, float]
    """Pruning pass, such as "ImportanceRule at step 28000" -> seconds."""
    peak_host_mb: float | None = None
    """Peak memory of the process, 10^6 bytes, from the start of the command (where Linux can tell) to its end."""
    peak_device_mb: float | None = None
    """Peak of what torch allocated on the GPU, 10^6 bytes; None on a CPU."""
    frame_ms: dict[str, float]
    """Part of a frame (scene, splat, effects by name, output) -> median milliseconds; they add up to the frame."""
    nodes: dict[str, NodeCost]
    effects: dict[str, float]
    """Name of an effect of the scene, or "masks" -> additional milliseconds of a frame with it."""
    gains: dict[str, EffectGain] = field(default_factory=dict)
    """Name of an effect of the scene -> what it brings; empty: the record is older."""
    noise: Noise | None = None
    """Noise while ``frame_ms``, ``nodes`` and ``effects`` were measured."""

    def __post_init__(self) -> None:
        if self.wall_seconds is not None and abs(sum(self.phases.values()) / self.wall_seconds - 1) > _BELONGS:
            raise ValueError(
                f"the phases are {sum(self.phases.values()):g} s of {self.wall_seconds:g} s of wall clock: each second "
                "belongs to one phase; train the run again"
            )


COSTS = JsonFile("records/cost.json", CostRecord)


def update_costs(run: Path, **parts: object) -> None:
    """Rewrites some fields of a run's costs. The others stay, or are empty if they were never written."""
    empty = CostRecord(phases={}, step_ms={}, passes={}, frame_ms={}, nodes={}, effects={})
    COSTS.write(run, replace(COSTS.find(run) or empty, **parts))


def stage_costs(seconds: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Return ``phases`` and ``passes`` from the seconds of each stage.

    >>> stage_costs({"train": 90.0, "prune/ImportanceRule at step 28000": 4.0})
    ({'train': 90.0, 'prune': 4.0}, {'ImportanceRule at step 28000': 4.0})
    """
    phases: defaultdict[str, float] = defaultdict(float)
    passes = {}
    for name, value in seconds.items():
        stage, _, detail = name.partition("/")
        phases[stage] += value
        if stage == PRUNE:
            passes[detail] = value
    return dict(phases), passes


def step_costs(run: Path) -> dict[str, float]:
    """Return ``step_ms`` from a run's ``phases.csv``; empty without the file."""
    steps: defaultdict[tuple[str, int], float] = defaultdict(float)
    for row in STEP_PHASES.find(run) or ():
        steps[_part(row.phase), row.step] += row.milliseconds
    by_part: defaultdict[str, list[float]] = defaultdict(list)
    for (part, _), value in steps.items():
        by_part[part].append(value)
    return {part: statistics.median(values) for part, values in by_part.items()}


def _part(phase: str) -> str:
    return "losses" if phase.startswith("loss ") else _PARTS.get(phase, phase)
