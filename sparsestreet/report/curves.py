"""Held-out PSNR over the seconds of training, and how long each arm takes to a quality."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from sparsestreet.records.held_out import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.report.arms import Arm, Unit, plain_of, unit_of
from sparsestreet.report.grid import Cell, Grid

BELOW = (1.0, 0.5, 0.1)
"""dB below the end of the plain run: the qualities whose time is asked for."""


@dataclass(frozen=True)
class QualityCurve:
    """One run's probe of held-out views."""

    seconds: tuple[float, ...]
    """Of training, without evaluation."""
    psnr: tuple[float, ...]
    """Full image, dB."""


def curves_of(arm: Arm) -> dict[Unit, QualityCurve]:
    """Scene and seed -> curve, of the runs that hold views out and have one."""
    return {
        unit_of(record.summary): curve
        for record in arm.records
        if record.summary.run.split != "none" and (curve := _curve(HELD_OUT_CURVE.find(record.folder) or ())).seconds
    }


def _curve(looks: Sequence[HeldOutLook]) -> QualityCurve:
    points = [(look.seconds, look.psnr_full) for look in looks if look.psnr_full is not None]
    return QualityCurve(tuple(at for at, _ in points), tuple(psnr for _, psnr in points))


def seconds_to(curve: QualityCurve, psnr: float) -> float | None:
    """Training seconds at the first look that is as good; None: never. Nothing is interpolated between looks."""
    return next((at for at, value in zip(curve.seconds, curve.psnr, strict=True) if value >= psnr), None)


def time_to_quality(arms: Sequence[Arm]) -> Grid | None:
    """Median seconds to the plain run's last quality less 1, 0.5 and 0.1 dB; None where no run has a curve."""
    curves = {arm.name: curves_of(arm) for arm in arms}
    if not any(curves.values()):
        return None
    rows = []
    for arm in arms:
        plain = plain_of(arm, arms)
        if plain is None or not curves[arm.name]:
            continue
        runs = tuple(record.folder.name for record in arm.records)
        cells = [Cell(_reached(curves[arm.name], curves[plain.name], below), runs=runs) for below in BELOW]
        rows.append((Cell(arm.title, runs=runs), *cells))
    header = (("", "arm"), *(("", f"base - {below:g} dB") for below in BELOW))
    notes = (
        "training seconds, evaluation left out, to the first look at held-out views that is as good: the median of the "
        "runs that get there; base: the last look of the plain run of the same scene and seed",
        "a look is a fixed probe of held-out views; nothing is interpolated between two looks",
    )
    return Grid("time_to_quality", "Time to quality", header, tuple(rows), notes)


def _reached(ours: dict[Unit, QualityCurve], plain: dict[Unit, QualityCurve], below: float) -> str:
    shared = ours.keys() & plain.keys()
    times = [seconds_to(ours[unit], plain[unit].psnr[-1] - below) for unit in shared]
    reached = [time for time in times if time is not None]
    if not reached:
        return "not reached" if shared else "-"
    text = f"{statistics.median(reached):.1f} s"
    return text if len(reached) == len(times) else f"{text} ({len(reached)} of {len(times)})"
