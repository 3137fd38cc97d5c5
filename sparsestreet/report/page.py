"""A sweep's report as one HTML file that needs no network and no other file."""

import base64
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

from PIL import Image

from sparsestreet.pictures.images import drawn_views, picture_path
from sparsestreet.records.run import FailedRun
from sparsestreet.records.summary import QUALITY
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.tables import ABSENT, THEIRS, Cell, Grid, frames_steady, training_steady, without_empty
from sparsestreet.report.variants import Variant

_MAX_FULL_SIZE_COLUMNS = 14
"""Columns from which on a table is printed smaller."""
_HERE = Path(__file__).parent
_NOTHING_FROM_OUTSIDE = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


@dataclass(frozen=True, kw_only=True)
class Page:
    """The content of the page."""

    title: str
    notes: Sequence[str]
    """Notes that concern all runs."""
    grids: Sequence[Grid]
    figures: Sequence[tuple[str, str]]
    """Caption and SVG."""
    pictures: str | None
    """The JSON of ``comparison_data``."""
    records: Sequence[RunRecord]
    failures: Sequence[tuple[Path, FailedRun]]
    summary_line: Sequence[str] = ()
    """Sentences that say what follows from the numbers; none where the runs are too few."""


def html(page: Page) -> str:
    """Return the whole file."""
    sets = _sets(page.grids)
    parts = [
        f"<h1>{escape(page.title)}</h1>",
        f"<p class='soft'>{len(page.records)} runs with a record, {len(page.failures)} failed. "
        "Every number links to the runs that it is of, with their records, configurations and commits.</p>",
        _summary_line(page.summary_line),
        _navigation(page),
        _notes(page.notes),
        *(_grid(grid, sets) for grid in page.grids),
        *(_figure(index, *figure) for index, figure in enumerate(page.figures)),
        _comparison(page.pictures),
        _failures(page.failures),
        _sources(sets),
        "<h2 id='runs'>Runs</h2>",
        *map(_run, page.records),
        "<h2 id='configurations'>Configurations</h2>",
        *_configurations(page.records),
    ]
    return (
        "<!doctype html>\n<html lang='en'>\n<head>\n<meta charset='utf-8'>\n"
        f'<meta http-equiv="Content-Security-Policy" content="{_NOTHING_FROM_OUTSIDE}">\n'
        "<meta name='viewport' content='width=device-width, initial-scale=1'>\n<link rel='icon' href='data:,'>\n"
        f"<title>{escape(page.title)}</title>\n<style>\n{_asset('page.css')}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + f"\n<script>\n{_asset('page.js')}</script>\n</body>\n</html>\n"
    )


def _asset(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _navigation(page: Page) -> str:
    targets = [(grid.name, grid.title.partition(":")[0]) for grid in page.grids]
    targets += [("figures", "Figures")] if page.figures else []
    targets += [("compare", "Pictures")] if page.pictures else []
    targets += [("failed", "Failed runs")] if page.failures else []
    targets += [("runs", "Runs"), ("configurations", "Configurations")]
    return "<nav>" + "".join(f"<a href='#{name}'>{escape(title)}</a>" for name, title in targets) + "</nav>"


def _notes(notes: Sequence[str]) -> str:
    return "<ul class='notes'>" + "".join(f"<li>{escape(note)}</li>" for note in notes) + "</ul>" if notes else ""


def _summary_line(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    return "<section id='verdict'>" + "".join(f"<p>{escape(one)}</p>" for one in sentences) + "</section>"


def _sets(grids: Sequence[Grid]) -> dict[tuple[str, ...], str]:
    """Return names of the runs that a number comes from -> the place on the page that lists them."""
    several = dict.fromkeys(cell.runs for grid in grids for row in grid.rows for cell in row if len(cell.runs) > 1)
    return {runs: f"of-{index}" for index, runs in enumerate(several)}


def _grid(grid: Grid, sets: Mapping[tuple[str, ...], str]) -> str:
    header, rows = without_empty(grid.header, grid.rows)
    grid = replace(grid, header=tuple(header), rows=tuple(rows))
    above = "".join(f"<th class='above' colspan='{span}'>{escape(text)}</th>" for text, span in grid.spans)
    above = f"<tr>{above}</tr>" if any(text for text, _ in grid.spans) else ""
    heads = "".join(
        f"<th{' class=theirs' if heading.endswith(THEIRS) else ''}>{escape(heading)}</th>" for _, heading in grid.header
    )
    rows = "\n".join("<tr>" + "".join(_cell(cell, sets) for cell in row) + "</tr>" for row in grid.rows)
    wide = "wide many" if len(grid.header) > _MAX_FULL_SIZE_COLUMNS else "wide"
    return (
        f"<section id='{grid.name}'><h2>{escape(grid.title)}</h2>\n<div class='{wide}' tabindex='0'><table><thead>"
        f"{above}<tr>{heads}</tr></thead>\n<tbody>\n{rows}\n</tbody></table></div>\n{_notes(grid.notes)}</section>"
    )


def _cell(cell: Cell, sets: Mapping[tuple[str, ...], str]) -> str:
    text = f"<b>{escape(cell.text)}</b>" if cell.bold else escape(cell.text)
    if cell.runs and cell.text != ABSENT:
        target = sets.get(cell.runs, f"run-{cell.runs[0]}")
        text = f"<a href='#{escape(target)}'>{text}</a>"
    title = f" title='{escape(cell.exact)}'" if cell.exact else ""
    return f"<td{' class=theirs' if cell.published else ''}{title}>{text}</td>"


def _figure(index: int, caption: str, svg: str) -> str:
    heading = "<h2 id='figures'>Figures</h2>" if index == 0 else ""
    found = re.search(r'<svg[^>]* width="([0-9.]+pt)"', svg)
    natural = found[1] if found else "100%"
    return (
        f"{heading}<figure><div class='drawing' tabindex='0' style='--natural: {natural}'>{svg}</div>"
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _comparison(pictures: str | None) -> str:
    if pictures is None:
        return ""
    choices = "".join(
        f"<label>{name}<select id='choose-{name}'></select></label>" for name in ("view", "left", "right")
    )
    return (
        f"<h2 id='compare'>Pictures</h2><div class='compare'><div class='choice'>{choices}</div><div class='stage'>"
        "<img alt=''><img alt=''><i></i><span class='left'></span><span class='right'></span>"
        "<input type='range' min='0' max='100' value='50' aria-label='where the left picture ends'></div></div>"
        "<p class='soft'>Held-out views as evaluation drew them; re-encoded as WebP for this page, so that no number "
        "can be taken from them.</p><noscript><p>The pictures need the script of this page.</p></noscript>"
        f"<script type='application/json' id='pictures'>{pictures}</script>"
    )


def _failures(failures: Sequence[tuple[Path, FailedRun]]) -> str:
    if not failures:
        return ""
    entries = "\n".join(
        f"<details class='bad' id='run-{escape(folder.name)}'><summary>{escape(failure.label)}, seed {failure.seed}: "
        f"{escape(failure.error)}</summary><pre>{escape(failure.command)}\n\n{escape(failure.trace)}</pre></details>"
        for folder, failure in failures
    )
    return f"<h2 id='failed'>Failed runs</h2>\n{entries}"


def _sources(sets: Mapping[tuple[str, ...], str]) -> str:
    lines = "\n".join(
        f"<li id='{name}'>" + ", ".join(f"<a href='#run-{escape(run)}'>{escape(run)}</a>" for run in runs) + "</li>"
        for runs, name in sets.items()
    )
    return f"<h2>What numbers are of</h2>\n<ul class='notes'>\n{lines}\n</ul>" if lines else ""


def _run(record: RunRecord) -> str:
    summary, run = record.summary, record.summary.run
    metrics = {
        f"{split}: {name}": f"{one.mean:.6g} over {one.images} images"
        for split, found in summary.quality.items()
        for name, one in found.items()
        if one.mean is not None
    }
    said = {
        "command": run.command,
        "commit": f"{run.source.commit or 'none'}{' with uncommitted changes' if run.source.dirty else ''}",
        "measured by commit": summary.evaluated.source.commit or "none",
        "trained on": f"{run.device}, {run.threads} threads, {run.machine.system}, torch {run.machine.torch}",
        "scene": f"{run.scene}, seed {run.seed}, held out: {run.split}",
        "steps": f"{run.steps:,} of {run.max_steps:,}",
        "training seconds": "-"
        if run.training_seconds is None
        else f"{run.training_seconds:.1f}{_steady(training_steady(summary))}",
        "Gaussians": ", ".join(f"{name} {count:,}" for name, count in summary.gaussians.items()),
        "held down by a cap": ", ".join(f"{name} {cap:,}" for name, cap in run.caps.items()) or "none",
        "bytes": f"{summary.bytes_total:,}",
        "ms a frame": f"{summary.latency.p50:.3f} ({summary.latency_protocol}; {summary.latency.device}"
        f"{_steady(frames_steady(summary))})",
        "guards": ", ".join(f"{name} {count:,}" for name, count in summary.guards.alarms.items()) or "none fired",
    } | metrics
    lines = "".join(f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in said.items())
    name = escape(record.folder.name)
    return (
        f"<details id='run-{name}'><summary>{name}</summary><p>records/summary.json of this run; "
        f"<a href='#config-{run.config_hash}'>configuration {run.config_hash}</a></p><dl>{lines}</dl></details>"
    )


def _steady(steady: bool) -> str:
    return "" if steady else ", on a machine that was not quiet"


def _configurations(records: Sequence[RunRecord]) -> list[str]:
    """Return each configuration once. Options outside its identity have the values of its first run."""
    once: dict[str, RunRecord] = {}
    for record in records:
        once.setdefault(record.summary.run.config_hash, record)
    return [
        f"<details id='config-{key}'><summary>{key} ({escape(record.summary.run.label)})</summary><pre>"
        + "\n".join(f"{escape(name)}={escape(str(value))}" for name, value in sorted(record.summary.run.config.items()))
        + "</pre></details>"
        for key, record in once.items()
    ]


WIDTH = 640
"""Pixels; wider pictures are scaled down to this width."""
VIEWS = 2
"""Number of views of each scene."""


def comparison_data(variants: Sequence[Variant]) -> str | None:
    """Return JSON of the views with their images as data URLs, truth first; None if there is no view to compare.

    Each scene shows one seed, which most of the variants have (the lowest of several), and the first ``VIEWS`` views
    that evaluation drew.
    """
    views = []
    scenes = sorted({record.summary.run.scene for variant in variants for record in variant.records})
    for scene in scenes:
        seed = _seed_of_most(variants, scene)
        shown = [(variant, record) for variant in variants if (record := _record(variant, scene, seed)) is not None]
        keys = drawn_views(shown[0][1].folder / "pictures")[:VIEWS] if shown else []
        views += [view for key in keys if (view := _view(scene, seed, key, shown)) is not None]
    # A tag inside the text would end the script element.
    return json.dumps(views).replace("</", "<\\/") if views else None


def _seed_of_most(variants: Sequence[Variant], scene: str) -> int:
    seeds = sorted({record.summary.run.seed for variant in variants for record in variant.records})
    return max(seeds, key=lambda seed: sum(_record(variant, scene, seed) is not None for variant in variants))


def _record(variant: Variant, scene: str, seed: int) -> RunRecord | None:
    for record in variant.records:
        run = record.summary.run
        if (run.scene, run.seed) == (scene, seed) and run.split != "none":
            return record
    return None


def _view(
    scene: str, seed: int, key: tuple[int, int], shown: Sequence[tuple[Variant, RunRecord]]
) -> dict[str, object] | None:
    pictures = [
        (variant, record, picture_path(record.folder / "pictures", *key, "render")) for variant, record in shown
    ]
    pictures = [(variant, record, path) for variant, record, path in pictures if path.is_file()]
    truth = picture_path(pictures[0][1].folder / "pictures", *key, "truth") if pictures else None
    if truth is None or not truth.is_file():
        return None
    images = [{"name": "truth", "label": "truth", "data": _embedded(truth)}]
    for variant, record, path in pictures:
        label = f"{variant.title}, {_psnr(record, key)}{record.summary.gaussians_total:,} Gaussians"
        images.append({"name": variant.title, "label": label, "data": _embedded(path)})
    return {"name": f"{scene}, seed {seed}, frame {key[0]}, camera {key[1]}", "images": images}


def _psnr(record: RunRecord, key: tuple[int, int]) -> str:
    images = QUALITY[record.summary.main_split].find(record.folder) or ()
    found = [image.regions["full"].psnr for image in images if (image.frame, image.camera) == key]
    return f"{found[0]:.2f} dB, " if found else ""


def _embedded(path: Path) -> str:
    with Image.open(path) as image:
        small = image.convert("RGB")
        if small.width > WIDTH:
            small = small.resize((WIDTH, round(small.height * WIDTH / small.width)), Image.Resampling.LANCZOS)
        buffer = io.BytesIO()
        small.save(buffer, "WEBP", quality=82)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
