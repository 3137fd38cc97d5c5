"""A record of what was measured beside a path."""

from pathlib import Path

from sparsestreet.records.summary import NOVEL, NovelRecord, NovelShift


def write_beside(run: Path, distances: dict[float, float], name: str = "fid", psnr: float | None = None) -> None:
    """Write ``novel.json`` with one distance at each offset."""
    truth = {} if psnr is None else {"psnr_full": psnr}
    shifts = tuple(
        NovelShift(offset=offset, views=6, distances={name: value}, truth=truth, true_views=6 if truth else 0)
        for offset, value in distances.items()
    )
    NOVEL.write(run, NovelRecord(command="evaluate", ramp=False, real_views=6, absent=None, shifts=shifts))
