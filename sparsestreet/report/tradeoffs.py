"""The cost of getting smaller: paired differences, and the best variant of a sweep at one quality or one size."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import pandas as pd

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.records.summary import HELD_OUT
from sparsestreet.report.collect import by_scene, mean_over_scenes
from sparsestreet.report.tables import (
    CAPPED,
    CONFIDENCE,
    GEOMETRY,
    LEFT_OUT,
    Cell,
    Grid,
    Quantity,
    Spread,
    number_cell,
    spread,
)
from sparsestreet.report.variants import Variant, busy_variants, masks_note, plain_of

LOSSES = (0.1, 0.3, 0.5)
"""Losses of full-image held-out PSNR, dB, that a smaller variant may have."""
SHARES = (0.25, 0.5, 0.75)
"""Shares of the plain variant's Gaussians that a smaller variant may keep."""


def measures(protocol: Protocol) -> tuple[Quantity, ...]:
    """Return the columns of quality under a protocol, and of its costs, with formats of their differences."""
    quality = (
        ("PSNR full", protocol.psnr, "{:+.2f}"),
        ("PSNR human", protocol.human[0], "{:+.2f}"),
        ("PSNR vehicle", protocol.vehicle[0], "{:+.2f}"),
        ("SSIM full", protocol.ssim, "{:+.4f}"),
        *((f"LPIPS {name.split('_')[1]}", name, "{:+.4f}") for name in protocol.lpips),
    )
    return (
        *(Quantity(heading, f"{HELD_OUT} {metric}", text) for heading, metric, text in quality),
        *(replace(one, text=one.text.replace("{:", "{:+")) for one in GEOMETRY),
        Quantity("Gaussians", "Gaussians", "{:+.1f}", relative=True),
        Quantity("MB", "MB", "{:+.1f}", relative=True),
        Quantity("ms/frame", "ms/frame", "{:+.1f}", relative=True, clock="frames"),
        Quantity("train s", "train s", "{:+.1f}", relative=True, clock="training"),
    )


def paired(variant: Variant, plain: Variant, column: str, relative: bool = False, clock: str = "") -> Spread | None:
    """Return the difference to the plain variant over the pairs of scene and seed that both have.

    ``relative``: in per cent of the plain variant's number. With a ``clock``, runs of a busy machine are left out.
    """
    ours, theirs = variant.units(column, clock=clock), plain.units(column, clock=clock)
    differences = 100 * (ours / theirs[theirs != 0] - 1) if relative else ours - theirs
    return spread_over_scenes(differences.dropna())


def spread_over_scenes(units: pd.Series) -> Spread | None:
    """Return the spread over scenes, each with the mean of its seeds; over the seeds of a single scene."""
    scenes = by_scene(units)
    return spread((scenes if len(scenes) > 1 else units).tolist())


def differences(variants: Sequence[Variant], protocol: Protocol) -> Grid:
    """Return the table that compares every variant with the plain variant of its method at the same place."""
    shown = [one for one in measures(protocol) if any(variant.mean(one.column) is not None for variant in variants)]
    rows, alone = [], []
    for variant in variants:
        plain = plain_of(variant, variants)
        if variant.sparsify == "none":
            continue
        if plain is None:
            alone.append(variant.name)
            continue
        runs = variant.run_names + plain.run_names
        found = [paired(variant, plain, one.column, one.relative, one.clock) for one in shown]
        n = max((gain.n for gain in found if gain), default=0)
        cells = [
            Cell(LEFT_OUT, runs=runs)
            if gain is None and one.clock and (variant.busy(one.clock) or plain.busy(one.clock))
            else difference_cell(gain, one.text, n, runs)
            for gain, one in zip(found, shown, strict=True)
        ]
        rows.append((Cell(f"{variant.title} - {_named(plain)}", runs=runs), Cell(str(n), runs=runs), *cells))
    notes = [
        f"differences paired by scene and seed, mean [{100 * CONFIDENCE:.0f} % t interval]; n: scenes, each the mean "
        "of its seeds, or the seeds of a single scene; bold where the interval excludes 0, never with n = 1",
        "no correction for the number of comparisons: of twenty intervals without effect one excludes 0",
    ]
    if alone:
        notes.append(f"no plain run (or several) at the same place to compare with: {', '.join(alone)}")
    header = (("", "arm - plain"), ("", "n"), *(("", f"{one.heading}{', %' if one.relative else ''}") for one in shown))
    notes += masks_note(record.summary for variant in variants for record in variant.records)
    notes += [*_caps(variants), *busy_variants(variants)]
    return Grid("differences", "Differences to the plain method", header, tuple(rows), tuple(notes))


def is_capped(plain: Variant) -> bool:
    """Whether a limit ended the growth of a run of the variant."""
    return any(record.summary.run.caps for record in plain.records)


def _named(plain: Variant) -> str:
    """Return the name of a plain variant, marked where its count is a limit's."""
    return f"{plain.name} {CAPPED}" if is_capped(plain) else plain.name


def _caps(variants: Sequence[Variant]) -> tuple[str, ...]:
    """Say what a share of a marked variant's Gaussians is a share of."""
    held = [variant.name for variant in variants if variant.sparsify == "none" and is_capped(variant)]
    said = "held down by max_gaussians, so that a share of its Gaussians is a share of that limit"
    return (f"{CAPPED} {', '.join(held)}: {said}",) if held else ()


def difference_cell(gain: Spread | None, form: str, n: int, runs: tuple[str, ...]) -> Cell:
    """Return mean and interval, bold if it excludes 0; with its own n if that is not the row's.

    >>> difference_cell(spread([-0.3, -0.2, -0.1]), "{:+.2f}", 3, ()).text
    '-0.20 [-0.45, +0.05]'
    """
    if gain is None:
        return Cell()
    text, exact = form.format(gain.mean), f"{gain.mean:.6g}"
    if gain.interval is not None:
        text += " [{}, {}]".format(*map(form.format, gain.interval))
        exact += ", interval {:.6g} to {:.6g}".format(*gain.interval)
    text = text if gain.n == n else f"{text} (n={gain.n})"
    return Cell(text, gain.proven, runs=runs, exact=f"{exact}, n = {gain.n}")


@dataclass(frozen=True)
class _Candidate:
    """A variant beside its plain one, over the scenes and seeds that both have."""

    variant: Variant
    plain: Variant
    gain: Spread
    """dB, negative if the variant is worse."""
    share: float
    """Per cent of the plain variant's Gaussians that remain."""

    @property
    def loss(self) -> float:
        """What it loses, dB; negative if it is better."""
        return -self.gain.mean


def _candidates(plain: Variant, variants: Sequence[Variant], protocol: Protocol) -> list[_Candidate]:
    found = []
    for variant in variants:
        if plain_of(variant, variants) is not plain:
            continue
        gain = paired(variant, plain, f"{HELD_OUT} {protocol.psnr}")
        share = paired(variant, plain, "Gaussians", relative=True)
        if gain is not None and share is not None:
            found.append(_Candidate(variant, plain, gain, 100 * (1 + share.mean / 100)))
    return found


def matched_quality(variants: Sequence[Variant], protocol: Protocol) -> Grid:
    """Return the variants with the fewest Gaussians for each loss of ``LOSSES``; controls are only named."""
    limits = {f"at most {most:g} dB": most for most in LOSSES}
    rows, notes = _matched(variants, protocol, limits, "loss", "share", "smaller")
    notes = (f"{_OF_THIS_SWEEP}: plain counts as its own candidate", _NO_CONTROLS, *notes)
    return Grid("matched_quality", "Matched quality: the smallest arm", _CHOSEN, rows, notes)


def matched_budget(variants: Sequence[Variant], protocol: Protocol) -> Grid:
    """Return the variants with the best held-out PSNR for each share of ``SHARES``; controls are only named."""
    limits = {f"at most {100 * share:g} % of its Gaussians": 100 * share for share in SHARES}
    rows, notes = _matched(variants, protocol, limits, "share", "loss", "better")
    notes = (_OF_THIS_SWEEP, _NO_CONTROLS, *notes)
    return Grid("matched_budget", "Matched budget: the best arm", _CHOSEN, rows, notes)


def _matched(
    variants: Sequence[Variant], protocol: Protocol, limits: Mapping[str, float], limited: str, least: str, word: str
) -> tuple[tuple[tuple[Cell, ...], ...], tuple[str, ...]]:
    """Return a row and notes for each plain variant and limit: of what is within it, the candidate with the least."""
    rows, notes = [], []
    cost = attrgetter(least)
    for plain in (variant for variant in variants if variant.sparsify == "none"):
        candidates = _candidates(plain, variants, protocol)
        for said, most in limits.items():
            allowed = [one for one in candidates if getattr(one, limited) <= most]
            best, control = (
                min((one for one in allowed if bool(one.variant.control) == controls), key=cost, default=None)
                for controls in (False, True)
            )
            rows.append((Cell(f"{_named(plain)}, {said}"), *_chosen(best)))
            if control is not None and (best is None or cost(control) < cost(best)):
                notes.append(f"{rows[-1][0].text}: {_in_words(control)} is {word}")
    return tuple(rows), (*notes, *_caps(variants), *busy_variants(variants))


_OF_THIS_SWEEP = "of the arms of this sweep as they were run: nothing is interpolated"
_NO_CONTROLS = (
    "a control has the size of another arm and is no way to get small, so that none is chosen; one that would have "
    "been is named here. Numbers are of the scenes and seeds that the arm shares with the plain one"
)
_CHOSEN = tuple(
    ("", heading)
    for heading in ("allowed", "arm", "PSNR full, dB", "share, %", "Gaussians", "MB", "ms/frame", "train minutes")
)


def _in_words(one: _Candidate) -> str:
    return f"{one.variant.title}, {-one.loss:+.2f} dB at {one.share:.0f} % of the Gaussians,"


def _chosen(best: _Candidate | None) -> tuple[Cell, ...]:
    if best is None:
        return (Cell("none of this sweep"), *[Cell()] * (len(_CHOSEN) - 2))
    runs = best.variant.run_names

    def mean(column: str, form: str, clock: str = "") -> Cell:
        ours, theirs = best.variant.units(column), best.plain.units(column)
        found = mean_over_scenes(ours.reindex(ours.index.intersection(theirs.index)))
        return number_cell(found, form, runs, best.variant.busy(clock) if clock else "")

    numbers = (
        number_cell(-best.loss, "{:+.2f}", runs),
        number_cell(best.share, "{:.0f}", runs),
        mean("Gaussians", "{:,.0f}"),
        mean("MB", "{:.2f}"),
        mean("ms/frame", "{:.2f}", "frames"),
        mean("train minutes", "{:.2f}", "training"),
    )
    return (Cell(best.variant.title, runs=runs), *numbers)


LOSS = 0.3
"""dB of full-image held-out PSNR that a smaller variant may lose on average."""
MIN_PAIRS = 3
"""Pairs of scenes, or of seeds of one scene, below which an interval says next to nothing: with two, a t interval is
12.7 standard errors wide to each side."""


def summary_line(variants: Sequence[Variant], protocol: Protocol) -> tuple[str, ...]:
    """Return a sentence for each plain variant, then what limits them; nothing for one with too few pairs.

    Controls are no way to get small and are left out. The mean of a variant decides, and its interval is stated: where
    it reaches beyond the loss, a sentence says so.
    """
    found, wide, held = [], [], []
    for plain in (variant for variant in variants if variant.sparsify == "none"):
        compared = [
            one
            for one in _candidates(plain, variants, protocol)
            if one.variant is not plain and not one.variant.control and one.gain.n >= MIN_PAIRS
        ]
        if not compared:
            continue
        smaller = [one for one in compared if one.gain.mean >= -LOSS and one.share < 100]
        best = min(smaller, key=lambda one: one.share, default=None)
        found.append(_sentence(plain, compared, best))
        wide += [best.variant.name] if best and best.gain.interval and best.gain.interval[0] < -LOSS else []
        held += [plain.name] if is_capped(plain) else []
    if wide:
        found.append(
            f"Intervals that reach beyond {LOSS:g} dB: {', '.join(wide)}. More scenes or seeds may change this."
        )
    if held:
        found.append(f"A limit ended the growth of {', '.join(held)}: shares of it are shares of that limit.")
    return tuple(found)


def _sentence(plain: Variant, compared: Sequence[_Candidate], best: _Candidate | None) -> str:
    of = f"of {len(compared)} arms " if len(compared) > 1 else ""
    if best is None:
        nearest = max(compared, key=lambda one: one.gain.mean)
        return f"{plain.name}: {of}none is smaller within {LOSS:g} dB; {nearest.variant.name} has {_numbers(nearest)}."
    return f"{plain.name}: {of}the smallest within {LOSS:g} dB is {best.variant.name}, with {_numbers(best)}."


def _numbers(one: _Candidate) -> str:
    gain = one.gain
    interval = " [{:+.2f}, {:+.2f}]".format(*gain.interval) if gain.interval else ""
    return f"{one.share:.0f} % of the Gaussians, {gain.mean:+.2f} dB{interval} of held-out PSNR, n = {gain.n}"
