"""Read and check a bundle, which comes from anybody.

Its members have fixed names and limited sizes, records are read as strictly as those of a run, and nothing of it is
made, imported or written elsewhere than into a temporary folder.
"""

import math
import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory

from sparsestreet.atomic import check_regular
from sparsestreet.naming import one_line
from sparsestreet.records.configuration import config_hash
from sparsestreet.records.summary import QUALITY, SUMMARY, RunSummary, summarize
from sparsestreet.report.bundle import (
    BUNDLE,
    MEMBERS,
    SCENE,
    TABLES,
    Bundle,
    BundledRun,
    digest,
    folder_of,
    tables_of,
    this_version,
)

MAX_RECORD, MAX_RECORDS, MAX_SCENE = 1 << 25, 1 << 30, 1 << 34
"""Bytes of one member, of all of them but scenes, and of one scene."""
_NAMES = re.compile(
    rf"{re.escape(BUNDLE.name)}|{re.escape(TABLES)}|runs/\d{{4}}/(?:{'|'.join(map(re.escape, MEMBERS))})", re.ASCII
)
_DIGITS = 1.1e-5
"""Relative: images and their mean are both rounded to 6 significant digits, by 5e-6 each."""
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError)
"""How zipfile fails where an archive is damaged, packed otherwise or encrypted."""


@dataclass(frozen=True)
class Unpacked:
    """A bundle whose members but scenes lie in a folder."""

    path: Path
    bundle: Bundle
    root: Path
    archive: zipfile.ZipFile

    def summaries(self) -> list[RunSummary]:
        """Return the record of each run. Raises RecordError for a malformed one."""
        return [SUMMARY.read(folder_of(self.root, number)) for number in range(1, len(self.bundle.runs) + 1)]

    def extract(self, number: int, name: str, path: Path) -> bool:
        """Write a file of the n-th run to a path; False if the bundle has none. Raises ValueError if it is damaged."""
        member = f"runs/{number:04d}/{name}"
        if member not in self.archive.namelist():
            return False
        path.parent.mkdir(parents=True, exist_ok=True)
        with _whole(self.path), self.archive.open(member) as source, path.open("wb") as file:
            shutil.copyfileobj(source, file)
        return True

    def faults(self) -> Iterator[str]:
        """Yield a line for each member, record and table that is not what the others say; nothing if all agree."""
        yield from self._wrong_bytes()
        readable = True
        for number, listed in enumerate(self.bundle.runs, start=1):
            try:
                yield from (f"row {number}: {fault}" for fault in _contradictions(listed, folder_of(self.root, number)))
            except ValueError as error:
                readable = False
                yield self._said(error)
        if readable:
            yield from self._wrong_tables()

    def _wrong_bytes(self) -> Iterator[str]:
        listed = {f"runs/{n:04d}/{name}": hash for n, run in enumerate(self.bundle.runs, start=1)
                  for name, hash in run.files.items()} | {TABLES: self.bundle.tables}  # fmt: skip
        there = set(self.archive.namelist()) - {BUNDLE.name}
        for name in sorted(there ^ listed.keys()):
            yield f"{one_line(name)} is {'not listed' if name in there else 'listed and not there'}"
        for name in sorted(there & listed.keys()):
            with _whole(self.path):
                found = digest(self.archive.open(name))
            if found != listed[name]:
                yield f"{name} has the SHA-256 {found[:12]}..., bundle.json lists {one_line(listed[name][:12])}..."

    def _wrong_tables(self) -> Iterator[str]:
        try:
            made = tables_of(self.root, self.bundle).splitlines()
        except (ValueError, FileNotFoundError) as error:
            yield f"no tables can be made of the records: {self._said(error)}"
            return
        path, version = self.root / TABLES, this_version()
        stand = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []
        for number, (ours, theirs) in enumerate(zip_longest(made, stand, fillvalue=""), start=1):
            if ours != theirs:
                wrote = f" (written by version {self.bundle.sparsestreet}, this is {version})"
                other = "" if self.bundle.sparsestreet == version else wrote
                yield f"{TABLES}, line {number} is {_cut(theirs)}, the records give {_cut(ours)}{other}"
                return

    def _said(self, error: Exception) -> str:
        return str(error).replace(f"{self.root}/", "")


def _cut(line: str) -> str:
    return repr(one_line(line))


def _contradictions(listed: BundledRun, folder: Path) -> Iterator[str]:
    """Yield what a run's record says otherwise than the list, its configuration or its images."""
    summary = SUMMARY.read(folder)
    run = summary.run
    for name in (field.name for field in fields(BundledRun)[:-1]):
        if getattr(run, name) != getattr(listed, name):
            yield f"its record has {name} {getattr(run, name)}, bundle.json {getattr(listed, name)}"
    if (found := config_hash(run.config)) != run.config_hash:
        yield f"its configuration has the hash {found}, its record says {run.config_hash}"
    if run.config.get("seed") != run.seed:
        yield f"its configuration has seed {run.config.get('seed')}, its record says {run.seed}"
    for split, metrics in summary.quality.items():
        images = summarize(QUALITY[split].find(folder) or ())
        for name, stated in metrics.items():
            mean = images[name].mean if name in images else None
            if mean is not None and not math.isclose(mean, stated.mean or 0.0, rel_tol=_DIGITS):
                yield f"its images have a mean {name} of {mean:.6g} ({split}), its record says {stated.mean}"


@contextmanager
def unpacked(path: Path) -> Iterator[Unpacked]:
    """Yield a bundle with all but its scenes in a temporary folder.

    Raises FileNotFoundError where there is none, ValueError, in one line, for what is no bundle or is damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no {path}: name a bundle that sparsestreet report bundle=FILE.zip wrote")
    check_regular(path)
    with TemporaryDirectory() as temporary, _opened(path) as archive:
        root = Path(temporary)
        with _whole(path):
            for name, entry in _entries(archive).items():
                if not name.endswith(SCENE):
                    place = root / name
                    place.parent.mkdir(parents=True, exist_ok=True)
                    place.write_bytes(archive.read(entry))
        try:
            bundle = BUNDLE.read(root)
        except ValueError as error:
            raise ValueError(f"{path}: {str(error).replace(f'{root}/', '')}") from error
        yield Unpacked(path, bundle, root, archive)


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    with _whole(path):
        archive = zipfile.ZipFile(path)
    with archive:
        yield archive


def _entries(archive: zipfile.ZipFile) -> Mapping[str, zipfile.ZipInfo]:
    """Return the members by name. Raises BadZipFile for one that no bundle has, which is then not read."""
    found: dict[str, zipfile.ZipInfo] = {}
    for entry in archive.infolist():
        name, kind = entry.filename, stat.S_IFMT(entry.external_attr >> 16)
        limit = MAX_SCENE if name.endswith(SCENE) else MAX_RECORD
        if not _NAMES.fullmatch(name) or name in found:
            raise zipfile.BadZipFile(f"a member is named {one_line(name)!r}, as none of a bundle is, or as another is")
        if kind not in (0, stat.S_IFREG):
            raise zipfile.BadZipFile(f"{name} is a link or a device")
        if entry.file_size > limit:
            raise zipfile.BadZipFile(f"{name} would have {entry.file_size:,} bytes, {limit:,} at most are read")
        found[name] = entry
    total = sum(entry.file_size for name, entry in found.items() if not name.endswith(SCENE))
    if total > MAX_RECORDS:
        raise zipfile.BadZipFile(f"its records would have {total:,} bytes, {MAX_RECORDS:,} at most are read")
    return found


@contextmanager
def _whole(path: Path) -> Iterator[None]:
    """Say of a broken archive that it is one."""
    try:
        yield
    except _BROKEN as error:
        raise ValueError(f"{path} is no bundle or is damaged ({error}): fetch it again") from error
