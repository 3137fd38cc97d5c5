"""Compares finished runs side by side, from their files alone."""

from collections.abc import Sequence
from pathlib import Path

from sparsestreet.pictures.images import read_pictures, write_png
from sparsestreet.pictures.sheets import Legend, SheetColumn, comparison_sheet
from sparsestreet.records.summary import HELD_OUT, QUALITY, SUMMARY, RunSummary
from sparsestreet.report.variants import repeats


def compare_runs(
    runs: Sequence[Path], sheet: Path, *, legend: Legend | None = None, titles: Sequence[str] | None = None
) -> None:
    """Write a sheet with a column for each run: renders, errors and centers of the images that all of them show.

    Args:
        runs: at least two run folders with records and pictures of the same images. Shares refer to the first.
        sheet: PNG to write.
        legend: node -> RGB of its centers, drawn on the sheet.
        titles: what each run is called; None: as in the report's tables.

    Raises RecordError for malformed records, ValueError if the runs are of different scenes or show different images.
    """
    summaries = [SUMMARY.read(run) for run in runs]
    scenes = {summary.run.scene for summary in summaries}
    if len(scenes) > 1:
        raise ValueError(f"the runs show different scenes, {', '.join(sorted(scenes))}: compare runs of one scene")
    names = list(titles) if titles is not None else _names(summaries)
    columns = [
        _column(run, summary, name, names[0], summaries[0].gaussians_total)
        for run, summary, name in zip(runs, summaries, names, strict=True)
    ]
    views = "held-out" if all(summary.main_split == HELD_OUT for summary in summaries) else "training"
    title = f"{summaries[0].run.scene}: PSNR over {summaries[0].images[summaries[0].main_split]} {views} images"
    write_png(sheet, comparison_sheet(columns, title=title, legend=legend))


def _names(summaries: Sequence[RunSummary]) -> list[str]:
    """Return names as in the report's tables, with the seed if only the seed tells two runs apart."""
    found = repeats(summaries)
    names = [next(variant.name for variant in found if summary in variant.runs) for summary in summaries]
    return [
        name if names.count(name) == 1 else f"{name} (seed {summary.run.seed})"
        for name, summary in zip(names, summaries, strict=True)
    ]


def _column(run: Path, summary: RunSummary, name: str, first: str, gaussians: int) -> SheetColumn:
    share = f", {100 * summary.gaussians_total / max(gaussians, 1):.0f} % of {first}" if name != first else ""
    capped = ", held down by a cap" if summary.run.caps else ""
    pictures = read_pictures(run / "pictures")
    found = {(one.frame, one.camera): one.regions["full"].psnr for one in QUALITY[summary.main_split].read(run)}
    psnr = {view: value for view, value in found.items() if value is not None}
    missing = [(picture.frame, picture.camera) for picture in pictures if (picture.frame, picture.camera) not in psnr]
    if missing:
        raise ValueError(f"{run} has pictures of (frame, camera) {missing} and no quality of them: evaluate it again")
    return SheetColumn(
        f"{name}, {summary.mean('psnr_full'):.2f} dB",
        f"{summary.gaussians_total:,} Gaussians{share}{capped}",
        pictures,
        [psnr[picture.frame, picture.camera] for picture in pictures],
    )
