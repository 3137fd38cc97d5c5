"""Answers that were computed before: one file each, found by a hash of everything that it depends on.

Runs on one log measure the same on its pixels and returns. What one has found the next takes from a folder that they
share (``Kept.get``). The file's name hashes the code of this package, what is read (``LogReader.identity``), the split,
and whatever else the answer depends on. So an answer is never brought up to date: other inputs are another file.

A file is an archive of arrays with one text of JSON, which says how they belong together. It is read without pickles,
and makes objects of no class but those that the caller names.
"""

import hashlib
import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy
import torch

from sparsestreet.atomic import acquire_lock, atomic_file, release_lock, writable
from sparsestreet.files import read_npz

log = logging.getLogger(__name__)

Value = TypeVar("Value")

MAX_BYTES = 4_000_000_000
"""Of a folder; the files that were not asked for longest make room. A street of 120 images has 30 MB of answers."""
_TREE = "tree"
_WAIT = 0.05
"""Seconds between two looks whether another process is done."""


class Kept:
    """Answers about one log and one part of it, and which of them this process found or made.

    ``get`` is asked where an answer takes long. Without a folder it computes whatever it is asked.
    """

    def __init__(self, folder: Path | str | None = None, *said: object) -> None:
        """
        Args:
            folder: of the files; None: nothing is kept.
            said: what all answers depend on.
        """
        self._folder = None if folder is None else Path(folder)
        self._said = said
        self.found: list[str] = []
        """Names of the answers that were there."""
        self.made: list[str] = []
        """Names of those that were computed."""

    def within(self, *said: object) -> "Kept":
        """The same folder, for answers that depend on more; it goes on counting what was found and made."""
        within = Kept(self._folder, *self._said, *said)
        within.found, within.made = self.found, self.made
        return within

    def get(self, name: str, said: object, make: Callable[[], Value], *kinds: type) -> Value:
        """Return the answer of ``make``: from its file, or computed and written there.

        Of several processes that ask at once one computes, the others wait. A damaged file is made anew, with a line
        that says so. What depends on a class from outside of this package is not kept, with a line that says so.

        Args:
            name: of the file.
            said: what the answer depends on beside what was said before: plain values, paths, tensors, and dataclasses,
                mappings and sequences of these.
            make: computes it. The answer has the same kinds of parts.
            kinds: the dataclasses in it.

        Raises OSError before any work if the folder cannot be written.
        """
        if self._folder is None:
            return make()
        try:
            digest = _digest((code_version(), self._said, name, said))
        except ForeignError as error:
            log.info("%s is not kept for the next run: it depends on %s, whose code may change", name, error)
            return make()
        path = self._folder / f"{name}-{digest}.npz"
        read = _read(path, kinds)
        if read is None:
            with _alone(path):
                read = _read(path, kinds)  # somebody may have written it meanwhile
                if read is None:
                    with atomic_file(path) as unfinished:
                        value = make()
                        _write(unfinished, value)
                    _make_room(self._folder)
                    self.made.append(name)
                    return value
        self.found.append(name)
        return read[0]

    def __str__(self) -> str:
        """What came from the folder, for the program's log."""
        made = f"; made for the next run: {', '.join(self.made)}" if self.made else ""
        return f"taken from {self._folder}: {', '.join(self.found) or 'nothing'}{made}"

    def __bool__(self) -> bool:
        return bool(self.found or self.made)


NOTHING = Kept()
"""Where every answer is computed."""


@cache
def code_version() -> str:
    """Hash of this package's source, and versions of the libraries that compute with it."""
    digest = hashlib.sha256(f"{torch.__version__} {np.__version__} {scipy.__version__}".encode())
    package = Path(__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


class ForeignError(TypeError):
    """What was said is an object of a class from outside of this package."""


def _digest(said: object) -> str:
    """16 hexadecimal digits. Raises ForeignError."""
    return hashlib.sha256(json.dumps(_plain(said)).encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    """What JSON can hold of anything that may be said: different for different values."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, torch.Tensor | np.ndarray):
        array = np.ascontiguousarray(value)
        return ["array", str(array.dtype), array.shape, hashlib.sha256(array.tobytes()).hexdigest()]
    if isinstance(value, Mapping):
        return ["items", [[_plain(key), _plain(entry)] for key, entry in value.items()]]
    if isinstance(value, Set):
        return ["set", sorted(map(_plain, value))]
    if isinstance(value, Sequence):
        return ["list", [_plain(entry) for entry in value]]
    if isinstance(value, Path):
        return ["path", str(value)]
    kind = type(value)
    if not is_dataclass(value) or not kind.__module__.startswith("sparsestreet."):
        raise ForeignError(f"{kind.__module__}.{kind.__qualname__}")
    return [kind.__qualname__, [[entry.name, _plain(getattr(value, entry.name))] for entry in fields(value)]]


def _write(path: Path, value: object) -> None:
    arrays: dict[str, np.ndarray] = {}
    tree = json.dumps(_packed(value, arrays))
    np.savez(path, allow_pickle=False, **{_TREE: np.array(tree)}, **arrays)


def _packed(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """The value as JSON, in which arrays are known by their names. What a dataclass has by default is left out."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, torch.Tensor | np.ndarray):
        name = f"array_{len(arrays)}"
        arrays[name] = np.ascontiguousarray(value).reshape(value.shape)
        return {"tensor" if isinstance(value, torch.Tensor) else "array": name}
    if isinstance(value, Mapping):
        return {"dict": [[key, _packed(entry, arrays)] for key, entry in value.items()]}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_packed(entry, arrays) for entry in value]}
    given = {entry.name: getattr(value, entry.name) for entry in fields(value) if entry.init}
    usual = {entry.name: entry.default for entry in fields(value)}
    return {
        type(value).__name__: {name: _packed(part, arrays) for name, part in given.items() if part is not usual[name]}
    }


def _read(path: Path, kinds: tuple[type, ...]) -> tuple[Any] | None:
    """The value alone; None where there is none. A damaged file is removed, with a line that says so."""
    try:
        arrays = read_npz(path)
        value = _unpacked(json.loads(str(arrays[_TREE])), arrays, {kind.__name__: kind for kind in kinds})
        with suppress(OSError):  # a folder that cannot be written serves all the same
            os.utime(path)
        return (value,)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        if path.exists():
            log.warning("%s is damaged (%s), so it is made anew", path, error)
            path.unlink(missing_ok=True)
        return None


def _unpacked(tree: Any, arrays: Mapping[str, np.ndarray], kinds: Mapping[str, type]) -> Any:
    if not isinstance(tree, dict):
        return tree
    ((tag, content),) = tree.items()
    if tag == "tensor":
        return torch.from_numpy(arrays[content])
    if tag == "array":
        return arrays[content]
    if tag == "dict":
        return {key: _unpacked(entry, arrays, kinds) for key, entry in content}
    if tag in ("tuple", "list"):
        entries = [_unpacked(entry, arrays, kinds) for entry in content]
        return entries if tag == "list" else tuple(entries)
    return kinds[tag](**{name: _unpacked(part, arrays, kinds) for name, part in content.items()})


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """No other process makes this file while the block runs."""
    lock = path.with_name(f".{path.name}.lock")
    with writable(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        held = acquire_lock(lock)
    if held is None:
        log.info("%s is being made by another process: waiting for it", path)
    while held is None:
        time.sleep(_WAIT)
        held = acquire_lock(lock)
    try:
        yield
    finally:
        release_lock(lock, held)


def _make_room(folder: Path) -> None:
    """Remove the files that were asked for longest ago, until no more than MAX_BYTES are left."""
    used = 0
    states = []
    for path in folder.glob("*.npz"):
        with suppress(FileNotFoundError):  # another process makes room too
            states.append((path.stat(), path))
    for state, path in sorted(states, key=lambda entry: entry[0].st_mtime_ns, reverse=True):
        used += state.st_size
        if used > MAX_BYTES:
            path.unlink(missing_ok=True)
