"""A bundle: the records behind a table in one zip, so that anybody can make the table again and train a row of it.

``bundle.json`` lists the runs, with what identifies each and the SHA-256 of its files. A run has its records, without
the folders of the machine that made them, and its scene if that is asked for. ``bundle_check`` reads it.
"""

import hashlib
import shutil
import stat
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from importlib import metadata
from io import BufferedIOBase
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from sparsestreet.atomic import atomic_file
from sparsestreet.metrics.definitions import PROTOCOLS
from sparsestreet.naming import one_line
from sparsestreet.records.configuration import IDENTITY_KEYS, Configuration, Setting, only
from sparsestreet.records.costs import COSTS
from sparsestreet.records.curves import HELD_OUT_CURVE
from sparsestreet.records.file import JsonFile, RunFile
from sparsestreet.records.run import CodeVersion, Machine
from sparsestreet.records.strict_json import version
from sparsestreet.records.summary import NOVEL, PRESETS, QUALITY, SUMMARY
from sparsestreet.report.collect import RunRecord, collect, without_folders
from sparsestreet.report.sections import sections, sections_markdown
from sparsestreet.report.sweep import sweep_markdown

FORMAT = 1
"""Version of ``bundle.json``; raised when a key or a member changes its meaning."""
TABLES = "tables.md"
SCENE, TRACKS = "scene.street", ".hydra/tracks.json"
"""Of a run: its scene, and the objects that it found."""
_COPIED: tuple[RunFile, ...] = (*QUALITY.values(), COSTS, HELD_OUT_CURVE)
MEMBERS = (*(file.name for file in (SUMMARY, NOVEL, PRESETS, *_COPIED)), TRACKS, SCENE)
"""Names of the files that a run may have."""
MAX_RUNS = 9_999
_DATE = (1980, 1, 1, 0, 0, 0)
"""The earliest that a zip can have: the same records make the same bytes on any day."""


@dataclass(frozen=True, kw_only=True)
class BundledRun:
    """A row of the list in ``bundle.json``: what identifies a run, and its files. Its record has the rest."""

    label: str
    scene: str
    seed: int
    config_hash: str
    data_hash: str
    command: str
    source: CodeVersion
    machine: Machine
    files: dict[str, str]
    """Name of a file in the run's folder -> SHA-256 of its bytes."""

    @property
    def title(self) -> str:
        """Label, scene and seed, in words."""
        return one_line(f"{self.label}, {self.scene}, seed {self.seed}")


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """The content of ``bundle.json``. The folder of the n-th run is ``runs/000n``."""

    format: int = version(FORMAT, "check it with the version of SparseStreet that wrote it")
    sparsestreet: str
    """Version that wrote it."""
    protocol: str
    baseline: str | None
    of_sweep: bool
    """Whether the tables are those of a sweep."""
    sweep: str | None
    """Name of that sweep in conf/sweep; None: any other."""
    tables: str
    """SHA-256 of the tables."""
    runs: tuple[BundledRun, ...]

    def __post_init__(self) -> None:
        if self.protocol not in PROTOCOLS:
            raise ValueError(f"protocol is {self.protocol!r}, expected one of {', '.join(PROTOCOLS)}")

    def row(self, name: str) -> int:
        """Return the number of a run, from 1 on, by that number or by its label. Raises ValueError for none or many."""
        rows = {str(number): number for number in range(1, len(self.runs) + 1)}
        found = [rows[name]] if name in rows else [n for n in rows.values() if self.runs[n - 1].label == name]
        if len(found) != 1:
            known = "; ".join(f"{n}: {self.runs[n - 1].title}" for n in (found or rows.values()))
            raise ValueError(f"{len(found) or 'no'} rows are named {one_line(name)!r}: say its number, of {known}")
        return found[0]


BUNDLE = JsonFile("bundle.json", Bundle)


def write_bundle(
    records: Sequence[RunRecord],
    path: Path,
    *,
    protocol: str,
    baseline: str | None = None,
    of_sweep: bool = False,
    sweep: str | None = None,
    pack: Callable[[Path, Path], None] | None = None,
) -> int:
    """Write the records of runs, and the tables that they make, as a zip; returns its bytes.

    Args:
        records: the runs, in the order of their numbers.
        path: the zip, written whole or not at all.
        protocol: name of the metrics' definitions.
        baseline: as in ``sections``; not of a sweep.
        of_sweep: whether the tables are those of a sweep.
        sweep: its name in conf/sweep.
        pack: puts ``SCENE`` and ``TRACKS`` of a run (its folder) into another folder; None: no scenes.

    Raises RecordError for malformed records, OSError where the file cannot be written, ValueError for too many runs.
    """
    if len(records) > MAX_RUNS:
        raise ValueError(f"a bundle has at most {MAX_RUNS:,} runs, got {len(records):,}: write several")
    with TemporaryDirectory() as temporary:
        root = Path(temporary)
        for number, record in enumerate(records, start=1):
            _lay(record, folder := folder_of(root, number))
            if pack is not None:
                pack(record.folder, folder)
        runs = tuple(_listed(folder_of(root, number)) for number in range(1, len(records) + 1))
        bundle = Bundle(
            sparsestreet=this_version(),
            protocol=protocol,
            baseline=baseline,
            of_sweep=of_sweep,
            sweep=sweep,
            tables="",
            runs=runs,
        )
        text = tables_of(root, bundle).encode()
        (root / TABLES).write_bytes(text)
        BUNDLE.write(root, replace(bundle, tables=hashlib.sha256(text).hexdigest()))
        _zip(root, path)
    return path.stat().st_size


def this_version() -> str:
    """Return the version of this package."""
    return metadata.version("sparsestreet")


def folder_of(root: Path, number: int) -> Path:
    """Return the folder of the n-th run."""
    return root / f"runs/{number:04d}"


def _lay(record: RunRecord, folder: Path) -> None:
    """Write the records of a run without the folders of its machine."""
    summary, run = record.summary, record.summary.run
    run = replace(run, command=without_folders(run.command), config=run.config | _last_words(run.config))
    evaluated, timed = (
        one and replace(one, command=without_folders(one.command)) for one in (summary.evaluated, summary.timed)
    )
    SUMMARY.write(folder, replace(summary, run=run, evaluated=evaluated, timed=timed))
    if (novel := NOVEL.find(record.folder)) is not None:
        NOVEL.write(folder, replace(novel, command=without_folders(novel.command)))
    if (presets := PRESETS.find(record.folder)) is not None:
        PRESETS.write(folder, replace(presets, command=without_folders(presets.command)))
    for file in _COPIED:
        if file.exists(record.folder):
            file.path(folder).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file.path(record.folder), file.path(folder))


def _last_words(config: Configuration) -> dict[str, Setting]:
    """Return the last words of paths among the options that are no part of the configuration's identity."""
    places = only(config, IDENTITY_KEYS).items()
    return {key: Path(value).name for key, value in places if isinstance(value, str) and "/" in value}


def _listed(folder: Path) -> BundledRun:
    run = SUMMARY.read(folder).run
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    files = {path.relative_to(folder).as_posix(): digest(path.open("rb")) for path in paths}
    return BundledRun(**{field.name: getattr(run, field.name) for field in fields(BundledRun)[:-1]}, files=files)


def digest(file: IO[bytes] | BufferedIOBase) -> str:
    """Return the SHA-256 of what is left of a file, which is closed, in hexadecimal digits."""
    found = hashlib.sha256()
    with file:
        while part := file.read(1 << 20):
            found.update(part)
    return found.hexdigest()


def tables_of(root: Path, bundle: Bundle) -> str:
    """Return the tables of the runs that lie in a folder, as Markdown. Raises what ``sections`` raises."""
    records, protocol = collect([root / "runs"]), PROTOCOLS[bundle.protocol]
    if bundle.of_sweep:
        return sweep_markdown(records, bundle.sweep, protocol)
    return sections_markdown(sections(records, bundle.baseline, protocol))


def _zip(root: Path, path: Path) -> None:
    with atomic_file(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for file in sorted(file for file in root.rglob("*") if file.is_file()):
            entry = zipfile.ZipInfo(file.relative_to(root).as_posix(), _DATE)
            entry.create_system, entry.external_attr = 3, (stat.S_IFREG | 0o644) << 16
            entry.compress_type = zipfile.ZIP_STORED if file.name == SCENE else zipfile.ZIP_DEFLATED
            with file.open("rb") as source, archive.open(entry, "w", force_zip64=file.name == SCENE) as member:
                shutil.copyfileobj(source, member)
