"""``sparsestreet effects``: which effects a log calls for, and why, before anything is trained."""

import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from omegaconf import DictConfig

from sparsestreet.cli.config.compose import as_typed, composed, value_of
from sparsestreet.cli.config.log_from_options import with_found_data
from sparsestreet.cli.config.validate import config_problem, override_problem, with_effect_keys
from sparsestreet.records.run import EffectDecision

USAGE = """\
sparsestreet effects [data=... data.root=DIR] [effects.NAME=on|off] [out=DIR] [other options of train]
    print the plan of effects: what the log declares, what was measured on its images, lidar and boxes, the
    threshold, the decision and its reason, and the predicted cost; trains nothing and takes seconds; what it was
    measured from is drawn in DIR/evidence.png (outputs/effects/LOG/evidence.png)

  sparsestreet effects                                         of the embedded synthetic street
  sparsestreet effects data=auto data.root=DIR                 of a drive of your own
  sparsestreet effects data.log.settings.lens=[-0.15,0,0,0,0]  of a street that is seen through a lens
"""
WIDTH = 120


def effects(arguments: list[str]) -> int:
    """Print the plan; 2 on wrong options, 1 where the log is broken or cannot support what is forced."""
    if "--help" in arguments or "-h" in arguments:
        print(USAGE)
        return 0
    try:
        overrides, found = with_found_data(as_typed(with_effect_keys(arguments)))
        problem = override_problem(overrides) or config_problem(composed(overrides))
        if problem:
            raise ValueError(problem)
    except ValueError as error:
        print(f"sparsestreet effects: {error}", file=sys.stderr)
        return 2
    if found:
        print(found)
    try:
        asked = next((Path(value_of(text)) for text in overrides if text.startswith("out=")), None)
        print("\n".join(_plan(composed(overrides), asked)))
    except BrokenPipeError:
        raise  # somebody reads no more of our output
    except (ValueError, OSError) as error:
        print(f"sparsestreet effects: {error}", file=sys.stderr)
        return 1
    return 0


def _plan(cfg: DictConfig, out: Path | None) -> Iterator[str]:
    from sparsestreet.cli.runs.run import opened
    from sparsestreet.pictures.plots import draw_evidence

    times = [time.perf_counter()]
    _, data, recipe = opened(cfg)
    times.append(time.perf_counter())
    plan = recipe.plan(data)
    decisions = recipe.decisions(plan, data)
    times.append(time.perf_counter())
    log = data.driving_log
    yield f"{log.name}: {len(data.split.train)} training images of {log.num_cameras} cameras"
    yield from plan_lines(decisions)
    yield f"\nread in {times[1] - times[0]:.1f} s, planned in {times[2] - times[1]:.1f} s"
    panels = [panel for effect in plan.effects for panel in effect.finding.evidence()]
    if panels:
        picture = (Path("outputs/effects") / log.name if out is None else out) / "evidence.png"
        draw_evidence(picture, f"{log.name}: what its effects are decided from", panels)
        yield f"drawn: {picture}"


def plan_lines(decisions: Sequence[EffectDecision]) -> Iterator[str]:
    """A paragraph for each effect: its state, its number beside the threshold, the reason, the predicted cost.

    Without a number nothing was measured; what has no cost (it is found and never simulated) has no line of it.
    """
    for decision in decisions:
        source = "" if decision.source == "measured" and decision.value is None else decision.source
        yield f"\n{decision.name:<14}{'on' if decision.on else 'off':<5}{source:<10}{_number(decision)}".rstrip()
        yield from textwrap.wrap(decision.reason, WIDTH, initial_indent=" " * 14, subsequent_indent=" " * 14)
        if decision.numbers or decision.ms:
            yield f"{'':<14}{_cost(decision)}"


def _number(decision: EffectDecision) -> str:
    if decision.value is None:
        return ""
    noise = "" if decision.noise is None else f" ± {decision.noise:.2g}"
    limit = "" if decision.threshold is None else f" (on from {decision.threshold:g})"
    return f"{decision.value:.3g}{noise} {decision.unit}{limit}"


def _cost(decision: EffectDecision) -> str:
    would = "costs" if decision.on else "would cost"
    size = f"{4e-6 * decision.numbers:.3g} MB" if decision.numbers else "no memory"
    gain = "" if decision.gain is None else f"; predicted gain {decision.gain:+.2f} dB"
    return f"{would} {size}, {decision.ms:.2f} ms a frame{gain}"
