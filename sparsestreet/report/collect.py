"""The records of finished runs: found below folders, as one data frame, and as lines that a repository can keep."""

import re
import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from sparsestreet.records.configuration import config_hash, only
from sparsestreet.records.costs import COSTS, PRUNE, CostRecord
from sparsestreet.records.geometry import SEEN
from sparsestreet.records.strict_json import json_line, write_atomically
from sparsestreet.records.summary import NOVEL, SUMMARY, RunSummary
from sparsestreet.report.tables import CLOCKS, GEOMETRY


@dataclass(frozen=True)
class RunRecord:
    """A run's folder and its summary."""

    folder: Path
    summary: RunSummary


def collect(roots: Iterable[Path]) -> list[RunRecord]:
    """Return every run below the given folders once, sorted by path.

    Raises FileNotFoundError for a root without records, RecordError (naming the file) for a malformed one.
    """
    folders: set[Path] = set()
    for root in roots:
        if not root.is_dir():
            raise FileNotFoundError(f"{root} {'is a file' if root.exists() else 'is not there'}: name a folder of runs")
        found = SUMMARY.runs(root)
        if not found:
            raise FileNotFoundError(f"{root} holds no {SUMMARY.name}: train and evaluate a run there first")
        folders |= {folder.resolve() for folder in found}
    return [RunRecord(folder, SUMMARY.read(folder)) for folder in sorted(folders)]


def keep_records(records: Sequence[RunRecord], path: Path) -> None:
    """Write a line of JSON for each run, some kilobytes, so that a page's numbers can be checked without its scenes.

    A line has what identifies the run (label, log, seed, hashes, command without folders, commit, machine). It has the
    means of each split in the metrics' units, Gaussians and bytes by part, milliseconds of a frame and seconds of
    training.

    Raises OSError where the file cannot be written.
    """
    lines = [json_line(_kept(record.summary), str(record.folder)) for record in records]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, "".join(f"{line}\n" for line in lines))


def _kept(summary: RunSummary) -> dict[str, object]:
    run = summary.run
    means = {
        split: {name: one.mean for name, one in metrics.items() if one.mean is not None}
        for split, metrics in summary.quality.items()
    }
    return {
        **{name: getattr(run, name) for name in ("label", "method", "sparsify", "scene", "seed", "split", "steps")},
        "config_hash": run.config_hash,
        "data_hash": run.data_hash,
        "command": without_folders(run.command),
        "source": run.source,
        "machine": {**vars(run.machine), "device": run.device, "threads": run.threads},
        "sizes": summary.resolutions,
        "images": summary.images,
        "quality": means,
        **({} if summary.geometry is None else {"geometry": summary.geometry.groups}),
        "gaussians": summary.gaussians,
        "gaussians_total": summary.gaussians_total,
        "caps": run.caps,
        "bytes": summary.bytes_by_part,
        "bytes_total": summary.bytes_total,
        "frame_ms": summary.latency.p50,
        "quiet": summary.latency.noise.quiet and (run.noise is None or run.noise.quiet),
        "training_seconds": run.training_seconds,
    }


def without_folders(command: str) -> str:
    """Return a command with the last words of its paths: a record that leaves a machine names no folder of it.

    >>> without_folders("sparsestreet train data.root=/home/me/drive out=../runs/a b=1/2")
    'sparsestreet train data.root=drive out=a b=1/2'
    """
    return re.sub(r"(?<![^=\s,\[])(?:~|\.{0,2})/[^\s,\]]*/", "", command)


def check_definitions(records: Sequence[RunRecord]) -> None:
    """Raise ValueError if two records define one metric differently."""
    seen: dict[str, tuple[str, Path]] = {}
    for record in records:
        for name, definition in record.summary.definitions.items():
            known, folder = seen.setdefault(name, (definition, record.folder))
            if known != definition:
                raise ValueError(f"{name} means different things in {folder} and {record.folder}: evaluate one again")


CLIP_KEYS = ("data.log.first_frame", "data.log.last_frame")
"""Options that select a part of a log. Runs that differ in them have different scenes, as runs of different logs do."""
UNIT = ["scene", "clip", "seed"]
"""Columns that pair runs: a scene with the part of its log, and a seed."""
TRUTH = {
    "psnr_full": "PSNR to the truth, dB",
    "psnr_human": "PSNR of people, dB",
    "psnr_vehicle": "PSNR of vehicles, dB",
    "lpips_alex": "LPIPS (AlexNet)",
}
"""Metric of ``records/novel.json`` -> its heading."""


def run_frame(records: Sequence[RunRecord]) -> pd.DataFrame:
    """Return ``summary_frame`` with the numbers of the other records: a row for each run, NaN where none has it.

    More columns: parts of ``records/cost.json``, and ``NAME at 1 m`` for each distance beside the recorded path. Raises
    RecordError for a malformed record.
    """
    return pd.DataFrame([dict(_numbers(record.summary)) | dict(_of_other_records(record.folder)) for record in records])


def summary_frame(runs: Sequence[RunSummary]) -> pd.DataFrame:
    """Return a row for each run; a number that its summary lacks is NaN.

    Beside ``UNIT``: ``whole`` (trained on all views), ``frames`` and ``training`` (timed on a quiet machine), size and
    times under their headings, ``Gaussians of NODE``, ``SPLIT METRIC`` for each mean of an evaluation, ``all METRIC``
    over the images of all splits, and ``camera NUMBER METRIC`` for those of a camera.
    """
    return pd.DataFrame([dict(_numbers(run)) for run in runs])


def clip_of(run: RunSummary) -> tuple[str, str]:
    """Return what identifies a scene: the log, and the part of it that was read."""
    return run.run.scene, config_hash(only(run.run.config, CLIP_KEYS))


def _numbers(summary: RunSummary) -> Iterator[tuple[str, object]]:
    seconds = summary.run.training_seconds
    yield from zip(UNIT, (*clip_of(summary), summary.run.seed), strict=True)
    yield "whole", summary.run.split == "none"
    yield from ((clock, steady(summary)) for clock, steady in CLOCKS.items())
    yield "Gaussians", float(summary.gaussians_total)
    yield from ((f"Gaussians of {name}", float(count)) for name, count in summary.gaussians.items())
    yield "MB", summary.bytes_total / 1e6
    yield "ms/frame", summary.latency.p50
    yield "FPS", 1000 / summary.latency.p50
    yield "train s", seconds
    yield "train minutes", None if seconds is None else seconds / 60
    for split, metrics in summary.quality.items():
        yield from ((f"{split} {name}", one.mean) for name, one in metrics.items())
    yield from ((f"all {name}", summary.mean_of_all(name)) for name in summary.quality[summary.main_split])
    if summary.geometry is not None and (seen := summary.geometry.groups.get(SEEN)) is not None:
        percent = None if seen.within is None else 100 * seen.within
        yield from zip((one.column for one in GEOMETRY), (seen.median, percent), strict=True)
    for camera, means in summary.by_camera[summary.main_split].items():
        yield from ((f"camera {camera} {name}", mean) for name, mean in means.items())


def _of_other_records(run: Path) -> Iterator[tuple[str, object]]:
    costs = COSTS.find(run)
    if costs is not None:
        yield from _costs(costs)
    for meters, numbers in shifts_of(run).items():
        yield from ((f"{name} at {meters:g} m", value) for name, value in numbers.items())


def _costs(costs: CostRecord) -> Iterator[tuple[str, float | None]]:
    yield "pruning", costs.phases.get(PRUNE, 0.0)
    yield "whole command", costs.wall_seconds
    yield "forward", _step(costs, *_forward(costs))
    yield "backward", _step(costs, "backward")
    yield "optimizer", _step(costs, "optimizer")
    yield "host", costs.peak_host_mb
    yield "GPU", costs.peak_device_mb


def _forward(costs: CostRecord) -> tuple[str, ...]:
    """Return the parts of a step's forward pass; effects have their own names."""
    return ("scene", "splat", *costs.effects, "losses", "regularizers")


def _step(costs: CostRecord, *parts: str) -> float | None:
    found = [costs.step_ms[part] for part in parts if part in costs.step_ms]
    return sum(found) if found else None


def shifts_of(run: Path) -> dict[float, dict[str, float]]:
    """Return meters beside the path -> name of a number -> its mean over both sides; empty without such a record.

    Raises RecordError naming the file and the entry that is wrong.
    """
    record = NOVEL.find(run)
    sides: dict[float, dict[str, list[float]]] = {}
    for shift in () if record is None else record.shifts:
        found = sides.setdefault(abs(shift.offset), {})
        for name, value in (shift.distances | {TRUTH[name]: mean for name, mean in shift.truth.items()}).items():
            found.setdefault(name, []).append(value)
    return {meters: {name: statistics.fmean(some) for name, some in found.items()} for meters, found in sides.items()}


def by_unit(frame: pd.DataFrame, column: str) -> pd.Series:
    """Return scene, clip and seed -> the mean of the column over the runs that have it; runs without it are left out.

    >>> frame = pd.DataFrame({"scene": ["a", "a"], "clip": ["", ""], "seed": [0, 0], "MB": [1.0, 3.0]})
    >>> by_unit(frame, "MB").to_dict(), len(by_unit(frame, "FPS"))
    ({('a', '', 0): 2.0}, 0)
    """
    return _means(of_runs(frame, column), UNIT)


def of_runs(frame: pd.DataFrame, column: str) -> pd.Series:
    """Return scene, clip and seed -> the number of each run that has it; several runs may share a place."""
    known = frame.reindex(columns=[*UNIT, column]).dropna()
    return pd.Series(known.set_index(UNIT)[column], dtype=float)


def by_scene(units: pd.Series) -> pd.Series:
    """Return scene and clip -> the mean over its seeds."""
    return _means(units, UNIT[:2])


def mean_over_scenes(units: pd.Series) -> float | None:
    """Return the mean in which each scene counts once; None without values."""
    scenes = by_scene(units)
    return None if scenes.empty else statistics.fmean(scenes)


def _means(values: pd.Series, levels: list[str]) -> pd.Series:
    # The exact mean: a sum in floats would move numbers across the limits that tables are cut by.
    return values if values.empty else pd.Series(values.groupby(level=levels, sort=False).agg(statistics.fmean))
