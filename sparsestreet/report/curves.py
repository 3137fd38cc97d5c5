"""Held-out PSNR over the seconds of training, and the time that each arm takes to reach a quality."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from sparsestreet.records.held_out import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.report.arms import Arm, Unit, busy_arms, plain_of
from sparsestreet.report.grid import Cell, Grid

BELOW = (1.0, 0.5, 0.1)
"""Qualities whose time is reported, dB below the last quality of the plain run."""


@dataclass(frozen=True)
class QualityCurve:
    """The probe of held-out views of one run, or the mean of several runs."""

    seconds: tuple[float, ...]
    """Seconds of training without evaluation."""
    psnr: tuple[float, ...]
    """Full image, dB."""


def curves_of_runs(arm: Arm) -> dict[Unit, list[QualityCurve]]:
    """Returns scene and seed -> the curves of its runs, for the runs that hold views out and have a curve."""
    found = {unit: [_curve(HELD_OUT_CURVE.find(run.folder) or ()) for run in runs] for unit, runs in arm.runs().items()}
    known = {unit: [curve for curve in curves if curve.seconds] for unit, curves in found.items()}
    return {unit: curves for unit, curves in known.items() if curves}


def curves_of(arm: Arm) -> dict[Unit, QualityCurve]:
    """Returns scene and seed -> the curve of its run, or the mean of several runs."""
    return {unit: mean_curve(curves) for unit, curves in curves_of_runs(arm).items()}


def mean_curve(curves: Sequence[QualityCurve]) -> QualityCurve:
    """Returns mean seconds and mean dB at each look that all curves have.

    >>> mean_curve([QualityCurve((10.0, 20.0), (22.0, 25.0)), QualityCurve((14.0,), (24.0,))])
    QualityCurve(seconds=(12.0,), psnr=(23.0,))
    """
    looks = range(min(len(curve.seconds) for curve in curves))
    seconds = tuple(statistics.fmean(curve.seconds[look] for curve in curves) for look in looks)
    return QualityCurve(seconds, tuple(statistics.fmean(curve.psnr[look] for curve in curves) for look in looks))


def _curve(looks: Sequence[HeldOutLook]) -> QualityCurve:
    points = [(look.seconds, look.psnr_full) for look in looks if look.psnr_full is not None]
    return QualityCurve(tuple(at for at, _ in points), tuple(psnr for _, psnr in points))


def seconds_to(curve: QualityCurve, psnr: float) -> float | None:
    """Returns the training seconds at the first look with at least this PSNR, or None; looks are not interpolated.

    >>> seconds_to(QualityCurve(seconds=(10.0, 20.0), psnr=(22.0, 25.0)), 24.0)
    20.0
    """
    return next((at for at, value in zip(curve.seconds, curve.psnr, strict=True) if value >= psnr), None)


def time_to_quality(arms: Sequence[Arm]) -> Grid | None:
    """Returns median seconds to the plain run's last PSNR minus 1, 0.5 and 0.1 dB; None if no run has a curve."""
    curves = {arm.name: curves_of(arm) for arm in arms}
    if not any(curves.values()):
        return None
    rows = []
    for arm in arms:
        plain = plain_of(arm, arms)
        if plain is None or not curves[arm.name]:
            continue
        runs = tuple(record.folder.name for record in arm.records)
        times = [_reached(curves[arm.name], curves[plain.name], below) for below in BELOW]
        cells = [Cell(f"{time} {arm.busy('training') if ' s' in time else ''}".rstrip(), runs=runs) for time in times]
        rows.append((Cell(arm.title, runs=runs), *cells))
    header = (("", "arm"), *(("", f"base - {below:g} dB") for below in BELOW))
    notes = (
        "training seconds, evaluation left out, to the first look at held-out views that is as good: the median of the "
        "runs that get there; base: the last look of the plain run of the same scene and seed",
        "a look is a fixed probe of held-out views; nothing is interpolated between two looks",
    )
    return Grid("time_to_quality", "Time to quality", header, tuple(rows), (*notes, *busy_arms(arms)))


def _reached(ours: dict[Unit, QualityCurve], plain: dict[Unit, QualityCurve], below: float) -> str:
    shared = ours.keys() & plain.keys()
    times = [seconds_to(ours[unit], plain[unit].psnr[-1] - below) for unit in shared]
    reached = [time for time in times if time is not None]
    if not reached:
        return "not reached" if shared else "-"
    text = f"{statistics.median(reached):.1f} s"
    return text if len(reached) == len(times) else f"{text} ({len(reached)} of {len(times)})"
