"""What a run came to, in the few lines that a command ends with."""

from pathlib import Path

from sparsestreet.metrics.definitions import DRIVESTUDIO, Protocol
from sparsestreet.records.costs import COSTS
from sparsestreet.records.curves import HELD_OUT_CURVE
from sparsestreet.records.geometry import SEEN, VEHICLES, WITHIN, Geometry
from sparsestreet.records.run import RunDescription
from sparsestreet.records.summary import HELD_OUT, TRAINING, RunSummary
from sparsestreet.report.tables import frames_steady, training_steady

FALL = 0.5
"""dB by which a probe of held-out views may end below its best look without a word: looks vary by a few tenths."""

_VIEWS = {HELD_OUT: "held-out views", TRAINING: "training views"}


def result_lines(summary: RunSummary, out: Path, protocol: Protocol = DRIVESTUDIO) -> list[str]:
    """Return quality of each split, size and time, and where the pictures are; absent numbers are left out.

    Args:
        summary: the record of the run.
        out: the run's folder.
        protocol: the definitions of PSNR and SSIM.
    """
    run, latency = summary.run, summary.latency
    unsteady = " (on a machine that was not quiet)"
    steady, calm = ("" if one(summary) else unsteady for one in (frames_steady, training_steady))
    trained = [] if run.training_seconds is None else [f"{run.training_seconds:.0f} s of training{calm}"]
    size = [f"{summary.gaussians_total:,} Gaussians", f"{summary.bytes_total / 1e6:.2f} MB", *trained]
    return [
        *(_quality(summary, split, protocol) for split in (HELD_OUT, TRAINING) if split in summary.quality),
        *_ranges(summary.geometry),
        ", ".join([*size, f"{latency.p50:.1f} ms a frame{steady}"]),
        *_effects(run, out),
        *_warnings(run),
        *_better_before(out),
        f"pictures: {out / 'pictures' / 'sheet.png'}; curves: {out / 'curves'}; numbers: {out / 'records'}",
    ]


def _warnings(run: RunDescription) -> list[str]:
    said = (
        (run.held_back, "Gaussians that were not added because memory had no room"),
        (run.rested, "rows that took no step because their gradient was not finite, counted at each step"),
    )
    return [f"{what}: {', '.join(f'{name} {n:,}' for name, n in counts.items())}" for counts, what in said if counts]


def _effects(run: RunDescription, out: Path) -> list[str]:
    """What each effect brings beside what was foreseen, and those that cost more than they bring."""
    costs = COSTS.find(out)
    gains = {} if costs is None else costs.gains
    said = []
    for effect in (one for one in run.effects if one.on and one.name in gains):
        gain = gains[effect.name]
        if gain.full < 0:
            said.append(
                f"effects.{effect.name} costs more than it brings: {gain.full:+.2f} dB in {gain.images} images; "
                f"effects.{effect.name}=off trains without it"
            )
        elif effect.gain is not None:
            said.append(f"effects.{effect.name} brings {gain.full:.2f} dB (foreseen: {effect.gain:.2f})")
    return said


def _better_before(out: Path) -> list[str]:
    """What held-out views have lost since their best look: an average over the run would not show it."""
    looks = HELD_OUT_CURVE.find(out) or ()
    said = []
    for name, column in (("PSNR", "psnr_full"), ("vehicles", "psnr_vehicle"), ("people", "psnr_human")):
        seen = [(value, look.step) for look in looks if (value := getattr(look, column)) is not None]
        if seen and max(seen)[0] > seen[-1][0] + FALL:
            (best, step), (last, _) = max(seen), seen[-1]
            said.append(f"{name} {best:.2f} dB at step {step:,}, {last:.2f} dB at the end")
    return [f"held-out views were better before (curves/held_out.png): {'; '.join(said)}"] if said else []


def _ranges(geometry: Geometry | None) -> list[str]:
    """Errors along the lidar rays whose returns cameras see, and along those of vehicles."""
    groups = {} if geometry is None else geometry.groups
    said = [
        f"{name} {one.median:.3f} m ({100 * one.within:.0f} % within {WITHIN:g} m)"
        for name, one in (("in images", groups.get(SEEN)), ("on vehicles", groups.get(VEHICLES)))
        if one is not None and one.median is not None and one.within is not None
    ]
    if geometry is None or not said:
        return []
    sweeps = f"{len(geometry.sweeps)} {geometry.split.replace('_', '-')} sweeps"
    error, spread = geometry.intensity_error, geometry.intensity_spread
    if error is not None and spread is not None:
        said.append(f"intensities {error:.3f} off ({spread:.3f} if all were the same)")
    return [f"ranges along the rays of {sweeps}: median error {', '.join(said)}"]


def _quality(summary: RunSummary, split: str, protocol: Protocol) -> str:
    columns = (("PSNR", protocol.psnr), ("vehicles", protocol.vehicle[0]), ("people", protocol.human[0]))
    means = [(name, summary.mean(metric, split)) for name, metric in columns]
    said = [f"{name} {mean:.2f} dB" for name, mean in means if mean is not None]
    ssim = summary.mean(protocol.ssim, split)
    said += [] if ssim is None else [f"SSIM {ssim:.3f}"]
    return f"{_VIEWS[split]}: {', '.join(said)}"
