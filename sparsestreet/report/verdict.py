"""What a sweep says in a sentence: the arm with the fewest Gaussians within a stated loss of the plain one."""

from collections.abc import Sequence
from dataclasses import dataclass

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.records.quality import HELD_OUT
from sparsestreet.report.arms import Arm, plain_of
from sparsestreet.report.intervals import ConfidenceInterval
from sparsestreet.report.tradeoffs import is_capped, paired

LOSS = 0.3
"""dB of full-image held-out PSNR that a smaller arm may lose on average."""
FEWEST = 3
"""Pairs of scenes, or of seeds of one scene, below which an interval says next to nothing: with two, a t interval is
12.7 standard errors wide to each side."""


@dataclass(frozen=True)
class _Compared:
    """An arm beside its plain one, over the scenes and seeds that both have."""

    arm: Arm
    gain: ConfidenceInterval
    """dB, negative if the arm is worse."""
    kept: float
    """Per cent of the plain arm's Gaussians."""


def verdict(arms: Sequence[Arm], protocol: Protocol) -> tuple[str, ...]:
    """Returns a sentence for each plain arm, then what limits them; nothing for one whose others have too few pairs.

    Controls are no way to get small and are left out. The mean of an arm decides, and its interval is stated: where it
    reaches beyond the loss, a sentence says so.
    """
    found, wide, held = [], [], []
    for plain in (arm for arm in arms if arm.sparsify == "none"):
        compared = [one for arm in arms if plain_of(arm, arms) is plain and (one := _compared(arm, plain, protocol))]
        if not compared:
            continue
        smaller = [one for one in compared if one.gain.mean >= -LOSS and one.kept < 100]
        best = min(smaller, key=lambda one: one.kept, default=None)
        found.append(_sentence(plain, compared, best))
        wide += [best.arm.name] if best and best.gain.low is not None and best.gain.low < -LOSS else []
        held += [plain.name] if is_capped(plain) else []
    if wide:
        found.append(
            f"Intervals that reach beyond {LOSS:g} dB: {', '.join(wide)}. More scenes or seeds may change this."
        )
    if held:
        found.append(f"A limit ended the growth of {', '.join(held)}: shares of it are shares of that limit.")
    return tuple(found)


def _compared(arm: Arm, plain: Arm, protocol: Protocol) -> _Compared | None:
    if arm is plain or arm.control:
        return None
    gain = paired(arm, plain, lambda run: run.mean(protocol.psnr, HELD_OUT))
    share = paired(arm, plain, lambda run: float(run.gaussians_total), relative=True)
    if gain is None or share is None or gain.n < FEWEST:
        return None
    return _Compared(arm, gain, 100 + share.mean)


def _sentence(plain: Arm, compared: Sequence[_Compared], best: _Compared | None) -> str:
    of = f"of {len(compared)} arms " if len(compared) > 1 else ""
    if best is None:
        nearest = max(compared, key=lambda one: one.gain.mean)
        return f"{plain.name}: {of}none is smaller within {LOSS:g} dB; {nearest.arm.name} has {_numbers(nearest)}."
    return f"{plain.name}: {of}the smallest within {LOSS:g} dB is {best.arm.name}, with {_numbers(best)}."


def _numbers(one: _Compared) -> str:
    gain = one.gain
    interval = "" if gain.low is None else f" [{gain.low:+.2f}, {gain.high:+.2f}]"
    return f"{one.kept:.0f} % of the Gaussians, {gain.mean:+.2f} dB{interval} of held-out PSNR, n = {gain.n}"
