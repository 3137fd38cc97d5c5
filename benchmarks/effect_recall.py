"""Plant effects in synthetic streets, and ask plans what they see: ``python -m benchmarks.effect_recall``."""

import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.bench.records import RecordFile
from sparsestreet.cli.commands.bench import record_file
from sparsestreet.cli.commands.options import run_command
from sparsestreet.cli.config.compose import composed
from sparsestreet.cli.runs.run import opened
from sparsestreet.records.run import EffectDecision

LEVELS = (0.5, 2.0)
"""Times the dial at which an effect is meant to be called for: below the one it must be off, above the other on."""
USUAL = frozenset({"sky"})
"""Effects of every street under the sky."""


@dataclass(frozen=True)
class Plant:
    """One dial of synthetic streets."""

    name: str
    effect: str
    """The effect that it calls for."""
    dial: Callable[[float], str]
    """The option of ``train`` at a multiple of the threshold's dial."""

    def option(self, level: float) -> str:
        return f"data.log.settings.{self.dial(level)}"


PLANTS = (
    Plant("lens", "lens", lambda level: f"lens=[{-0.019 * level:.5f},0,0,0,0]"),
    Plant("shutter", "shutter", lambda level: f"readout={0.009 * level:.5f}"),
    Plant("hood", "hood", lambda level: f"hood={0.025 * level:.5f}"),
    Plant("exposure", "exposure", lambda level: f"exposure_walk={0.09 * level:.5f}"),
    Plant("white balance", "exposure", lambda level: f"white_balance={0.09 * level:.5f}"),
    Plant("camera poses", "camera_poses", lambda level: f"pose_noise=[{0.06 * level:.5f},{0.5 * level:.5f}]"),
    Plant("box poses", "box_poses", lambda level: f"box_noise=[{0.019 * level:.5f},{0.3 * level:.5f}]"),
)
"""Dials at thresholds for streets of ``SIZE``: what is measured in pixels depends on it."""
SIZE = ("data.log.settings.width=96", "data.log.settings.height=64")
TOGETHER = ("lens", "hood", "exposure")
"""Plants that one street has at once, at the upper level."""


@dataclass(frozen=True)
class Asked:
    """One street and what its plan says."""

    planted: str
    level: float
    """Times the threshold's dial; 0: nothing is planted."""
    seed: int
    expected: tuple[str, ...]
    on: tuple[str, ...]
    values: dict[str, float | None]
    """Effect -> what was measured."""

    @property
    def right(self) -> bool:
        return set(self.on) == set(self.expected)


def run_planted(
    plan: Callable[[Sequence[str]], Sequence[EffectDecision]],
    seeds: Iterable[int],
    file: RecordFile,
    say: Callable[[str], None] = print,
) -> list[Asked]:
    """Plans of clean streets, of one effect below and above its threshold, of a tunnel, and of three effects at once.

    Args:
        plan: options of ``train`` -> the decisions of its plan.
        seeds: of the streets.
        file: takes a record a street.
        say: takes a line a street, and the table at the end.
    """
    asked = []
    for seed in seeds:
        for name, level, expected, options in _streets():
            decisions = plan([*SIZE, f"seed={seed}", *options])
            on = tuple(one.name for one in decisions if one.on)
            one = Asked(name, level, seed, tuple(sorted(expected)), on, {one.name: one.value for one in decisions})
            asked.append(one)
            file.write("effects", one)
            say(f"seed {seed}, {name} x {level:g}: {', '.join(on) or 'nothing'}{'' if one.right else '   <- WRONG'}")
    for line in table(asked):
        say(line)
    return asked


def _streets() -> Iterable[tuple[str, float, frozenset[str], list[str]]]:
    yield "nothing", 0.0, USUAL, []
    for plant in PLANTS:
        low, high = LEVELS
        yield plant.name, low, USUAL, [plant.option(low)]
        yield plant.name, high, USUAL | {plant.effect}, [plant.option(high)]
    yield "tunnel", 1.0, frozenset(), ["data.log.settings.tunnel=true"]
    three = [plant for plant in PLANTS if plant.name in TOGETHER]
    yield "three at once", LEVELS[1], USUAL | {plant.effect for plant in three}, [p.option(LEVELS[1]) for p in three]


def table(asked: Sequence[Asked]) -> list[str]:
    """How often each effect is on, a row for what was planted, as Markdown; what must be on is bold."""
    effects = list(dict.fromkeys(name for one in asked for name in one.values))
    lines = [
        f"| planted | times the threshold | streets | {' | '.join(effects)} |",
        "|---|---:|---:|" + "---:|" * len(effects),
    ]
    for key in dict.fromkeys((one.planted, one.level) for one in asked):
        rows = [one for one in asked if (one.planted, one.level) == key]
        counts = (sum(name in one.on for one in rows) for name in effects)
        cells = (f"**{n}**" if name in rows[0].expected else str(n) for n, name in zip(counts, effects, strict=True))
        lines.append(f"| {key[0]} | {key[1]:g} | {len(rows)} | {' | '.join(cells)} |")
    return lines


USAGE = """\
python -m benchmarks.effect_recall [key=value ...]     effects planted in synthetic streets: what plans see of them

  seeds   streets of so many seeds (default: 10)
  out     folder for effects.jsonl (default: outputs/bench)
"""


@dataclass(frozen=True)
class RecallRequest:
    """The script's options."""

    seeds: int = 10
    out: Path = Path("outputs/bench")


def planned(overrides: Sequence[str]) -> tuple[EffectDecision, ...]:
    """Return the plan of a training with these options."""
    _, data, recipe = opened(composed(overrides))
    return recipe.decisions(recipe.plan(data), data)


def main(words: list[str]) -> int:
    """Plant and ask as the words say; 2 on wrong usage."""
    command = shlex.join(["python", "-m", "benchmarks.effect_recall", *words])

    def act(request: RecallRequest) -> None:
        run_planted(planned, range(request.seeds), record_file(request.out, "effects", command))

    return run_command("effect_recall", USAGE, words or ["seeds=10"], RecallRequest, act)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
