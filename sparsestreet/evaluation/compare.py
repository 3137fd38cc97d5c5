"""Two finished runs side by side, from what they left on disk (no torch)."""

from pathlib import Path

from sparsestreet.evaluation.pictures import Legend, comparison_sheet, read_pictures, write_png
from sparsestreet.evaluation.records import RunSummary, read_summary, summary_path


def compare_runs(plain: Path, ours: Path, sheet: Path, *, legend: Legend | None = None) -> None:
    """Write the comparison sheet of two run folders: truth, renders, errors, centers before and after pruning.

    Args:
        plain, ours: run folders with records and pictures of the same held-out images.
        sheet: PNG to write.
        legend: node class -> RGB of its centers, drawn on the sheet.

    Raises RecordError for malformed records, ValueError if the runs show other images or another scene.
    """
    before, after = read_summary(summary_path(plain)), read_summary(summary_path(ours))
    if before.run.scene != after.run.scene:
        raise ValueError(f"{plain} shows scene {before.run.scene!r}, {ours} {after.run.scene!r}: compare one scene")
    image = comparison_sheet(
        read_pictures(plain / "pictures"),
        read_pictures(ours / "pictures"),
        plain_label=_label(before),
        ours_label=_label(after),
        plain_count=before.gaussians_total,
        ours_count=after.gaussians_total,
        title=f"{before.run.scene}: {_run(before)} and {_run(after)}; PSNR over {before.images} held-out images",
        legend=legend,
    )
    write_png(sheet, image)


def _run(summary: RunSummary) -> str:
    return f"{summary.run.method} (seed {summary.run.seed})"


def _label(summary: RunSummary) -> str:
    psnr = summary.quality["psnr_full"].mean
    return summary.run.method if psnr is None else f"{summary.run.method}, {psnr:.2f} dB"
