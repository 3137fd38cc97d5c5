"""Quality off the recorded path (``records/novel.json``) and with other settings (``records/presets.json``)."""

from collections import Counter
from collections.abc import Iterator, Sequence

import pandas as pd

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.records.renders import PRESETS
from sparsestreet.report.frame import TRUTH, UNIT, by_unit, mean_over_scenes, shifts_of
from sparsestreet.report.tables import BUSY, Cell, busy_words, Grid, number_cell
from sparsestreet.report.tradeoffs import difference_cell, interval_over_scenes
from sparsestreet.report.variants import Variant

_PLACES = {title: place for place, title in enumerate(TRUTH.values())}


def mean_beside(variant: Variant, column: str) -> float | None:
    """Return the mean of a variant in which each scene counts once; None if no run has the number.

    Runs that were trained on all views count only if no run that holds views out has the number.
    """
    held = variant.mean(column)
    return variant.mean(column, whole=True) if held is None else held


def beside_the_path(variants: Sequence[Variant]) -> Grid | None:
    """Returns PSNR and LPIPS to the truth and every recorded distance, by meters; None if no run recorded any."""
    measured = [shifts_of(record.folder) for variant in variants for record in variant.records]
    found = {(name, meters) for shifts in measured for meters, numbers in shifts.items() for name in numbers}
    columns = sorted(found, key=lambda column: (column[0] not in _PLACES, _PLACES.get(column[0], 0), column))
    if not columns:
        return None
    rows = []
    for variant in variants:
        runs = variant.run_names
        means = [mean_beside(variant, f"{name} at {meters:g} m") for name, meters in columns]
        texts = [None if mean is None else _text(name, mean) for (name, _), mean in zip(columns, means, strict=True)]
        cells = [Cell() if text is None else Cell(text, runs=runs) for text in texts]
        rows.append((Cell(variant.title, runs=runs), *cells))
    header = (("", "arm"), *((name, f"{meters:g} m") for name, meters in columns))
    notes = (
        "mean of both sides; a distance of image sets is biased by their number, so that it compares arms of one sweep "
        "and says nothing by its level; only that of Inception's features is the published FID",
    )
    return Grid("beside", "Beside the recorded path", header, tuple(rows), notes)


def _text(name: str, mean: float) -> str:
    return f"{mean:.2f}" if name.endswith("dB") else f"{mean:.4g}"


_REGIONS = ("full", "human", "vehicle")
_COSTS = (("", "dB to exact", "{:.1f}"), ("", "ms/frame", "{:.2f}"))


def rendered_otherwise(variants: Sequence[Variant], protocol: Protocol) -> Grid | None:
    """Returns a row for each variant and preset that its runs have; None if no run has any.

    Raises RecordError for a malformed record.
    """
    recorded = [(variant, _renders(variant)) for variant in variants]
    labels = Counter(variant.label for variant in variants)
    rows = [
        row for variant, records in recorded for row in _rows(variant, records, protocol, labels[variant.label] > 1)
    ]
    if not rows:
        return None
    header = [("", "trained"), ("", "rendered"), ("", "n")]
    header += [(f"PSNR {region}", what) for region in _REGIONS for what in ("dB", "- as trained")]
    header += [(group, heading) for group, heading, _ in _COSTS]
    notes = [
        "one scene, the same held-out views; dB to exact: of the image against that of the same scene without cut-off "
        "and early stop; differences paired by scene and seed, with 95 % t intervals, bold where they exclude 0"
    ]
    notes += busy_words(", ".join(variant.name for variant, records in recorded if _busy(records)))
    return Grid("presets", "Trained one way, rendered another", tuple(header), tuple(rows), tuple(notes))


def _renders(variant: Variant) -> pd.DataFrame:
    """Return a row for each way in which runs that hold views out were rendered; else of runs trained on all views."""
    rows = []
    for record, run in zip(variant.records, variant.frame.to_dict("records"), strict=True):
        found = PRESETS.find(record.folder)
        rendered, quiet = (found.rendered, found.noise.quiet) if found else ((), True)
        for one in rendered:
            own = {"preset": one.preset, "trained": one.trained, "quiet": quiet}
            numbers = {"dB to exact": one.psnr_to_exact, "ms/frame": one.frame_ms}
            rows.append({name: run[name] for name in (*UNIT, "whole")} | own | numbers | one.quality)
    renders = pd.DataFrame(rows, columns=None if rows else [*UNIT, "whole", "preset", "trained", "quiet"])
    held = renders.loc[~renders["whole"].astype(bool)]
    return renders if held.empty else held


def _rows(variant: Variant, renders: pd.DataFrame, protocol: Protocol, several: bool) -> Iterator[tuple[Cell, ...]]:
    """Yield a row for each preset; the preset of training tells ``several`` variants of a label apart."""
    runs = variant.run_names
    trained = renders.loc[renders["trained"].astype(bool)]
    presets = sorted(set(trained["preset"]))
    title = f"{variant.label}, {presets[0]}" if several and len(presets) == 1 else variant.title
    for preset in dict.fromkeys(renders["preset"]):
        found = renders.loc[renders["preset"] == preset]
        n = found.groupby(UNIT).ngroups
        name = f"{preset}, as trained" if all(found["trained"]) else preset
        cells = [Cell(title, runs=runs), Cell(name, runs=runs), Cell(str(n), runs=runs)]
        for metric in (protocol.psnr, protocol.human[0], protocol.vehicle[0]):
            ours, theirs = by_unit(found, metric), by_unit(trained, metric)
            interval = None if found.equals(trained) else interval_over_scenes((ours - theirs).dropna())
            cells.append(number_cell(mean_over_scenes(ours), "{:.2f}", runs))
            cells.append(difference_cell(interval, "{:+.2f}", n, runs))
        for _, heading, form in _COSTS:
            mark = _busy(renders) if heading == "ms/frame" else ""
            cells.append(number_cell(mean_over_scenes(by_unit(found, heading)), form, runs, mark))
        yield tuple(cells)


def _busy(renders: pd.DataFrame) -> str:
    """Return the mark of milliseconds if a machine was not quiet; else an empty text."""
    return "" if all(renders["quiet"]) else BUSY
