"""``records/cost.json``: where the time and the memory of a run went.

Training and evaluation each write their part and keep the other's.
"""

import statistics
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from sparsestreet.records.file import JsonFile
from sparsestreet.records.run import Noise
from sparsestreet.records.step_phases import STEP_PHASES
from sparsestreet.records.strict_json import version

FORMAT = 1
"""Version of ``cost.json``; raised when a key changes its meaning."""

PRUNE = "prune"
"""The stage of pruning; each pass is a detail of it."""

_BELONGS = 0.02
"""Of the wall clock: as much may lie in no phase."""

_PARTS = {
    **dict.fromkeys(("splat backward", "scene backward", "sky backward", "ssim backward"), "backward"),
    "density statistics": "density",
    "logging": "loop",
}


@dataclass(frozen=True)
class NodeCost:
    """What a node class takes of a scene."""

    gaussians: int
    megabytes: float
    """10^6 bytes, rows and poses."""
    frame_ms: float
    """Median of a frame without it."""
    ms: float
    """What a frame takes longer with it: the median over pairs of frames, with and without. Noise can make it
    negative, and nodes that hide each other cost less together than the sum of both."""


@dataclass(frozen=True, kw_only=True)
class CostRecord:
    """The content of ``cost.json``. Raises ValueError where the phases are not the whole wall clock."""

    format: int = version(FORMAT, "train the run again")
    wall_seconds: float | None = None
    """Of the whole ``train`` command, torch's import included (the interpreter's own start, 0.2 s, is not), and of the
    interrupted ones that it went on from; None until one has ended."""
    phases: dict[str, float]
    """Part of the command (start, data, points, initialize, train, validate, prune, save, evaluate, latency, costs,
    novel, presets, pictures, other) -> seconds, each second in one of them."""
    step_ms: dict[str, float]
    """Part of a training step -> median milliseconds, over the noted steps that have it; empty where none was."""
    passes: dict[str, float]
    """Pruning pass, such as "ImportanceRule at step 28000" -> seconds."""
    peak_host_mb: float | None = None
    """10^6 bytes of the process, from the start of the command (where Linux can tell) to its end."""
    peak_device_mb: float | None = None
    """10^6 bytes that torch had allocated on the GPU at once; None on a CPU."""
    frame_ms: dict[str, float]
    """Part of a frame (scene, splat, effects by name, output) -> median milliseconds; they add up to the frame."""
    nodes: dict[str, NodeCost]
    effects: dict[str, float]
    """Name of an effect of the scene, or "masks" -> milliseconds that a frame takes longer with it."""
    noise: Noise | None = None
    """While ``frame_ms``, ``nodes`` and ``effects`` were measured."""

    def __post_init__(self) -> None:
        if self.wall_seconds is not None and abs(sum(self.phases.values()) / self.wall_seconds - 1) > _BELONGS:
            raise ValueError(
                f"the phases are {sum(self.phases.values()):g} s of {self.wall_seconds:g} s of wall clock: each second "
                "belongs to one phase; train the run again"
            )


COSTS = JsonFile("records/cost.json", CostRecord)


def update_costs(run: Path, **parts: object) -> None:
    """Write some fields of a run's costs anew; the others stay, or are empty where nobody wrote them."""
    empty = CostRecord(phases={}, step_ms={}, passes={}, frame_ms={}, nodes={}, effects={})
    COSTS.write(run, replace(COSTS.find(run) or empty, **parts))


def stage_costs(seconds: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """``phases`` and ``passes`` of the seconds by stage."""
    phases: Counter[str] = Counter()
    passes = {}
    for name, value in seconds.items():
        stage, _, detail = name.partition("/")
        phases[stage] += value
        if stage == PRUNE:
            passes[detail] = value
    return dict(phases), passes


def step_costs(run: Path) -> dict[str, float]:
    """``step_ms`` of what a run's ``phases.csv`` noted; empty without the file."""
    steps: defaultdict[tuple[str, int], float] = defaultdict(float)
    for row in STEP_PHASES.find(run) or ():
        steps[_part(row.phase), row.step] += row.milliseconds
    by_part: defaultdict[str, list[float]] = defaultdict(list)
    for (part, _), value in steps.items():
        by_part[part].append(value)
    return {part: statistics.median(values) for part, values in by_part.items()}


def _part(phase: str) -> str:
    return "losses" if phase.startswith("loss ") else _PARTS.get(phase, phase)
