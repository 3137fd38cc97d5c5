"""What was decoded once and may be asked for again, in a file without a name that ends with the process."""

import os
import tempfile
import weakref
from collections.abc import Hashable
from pathlib import Path
from typing import BinaryIO

from sparsestreet.data.frame_cache import Lock
from sparsestreet.data.problems import fault


class Spool:
    """Bytes by key. They go to the folder for temporary files (TMPDIR), not to memory."""

    def __init__(self) -> None:
        self._file: BinaryIO | None = None
        self._places: dict[Hashable, tuple[int, int]] = {}
        self._end = 0
        self._lock = Lock()

    def __contains__(self, key: Hashable) -> bool:
        return key in self._places

    def put(self, key: Hashable, data: bytes) -> None:
        """Raises LogError where the folder has no room."""
        try:
            with self._lock:
                file = self._opened()
                start, self._end = self._end, self._end + len(data)
            done = 0
            while done < len(data):
                done += os.pwrite(file.fileno(), data[done:], start + done)
        except OSError as error:
            folder, remedy = Path(tempfile.gettempdir()), "make room, or set TMPDIR to a folder with room"
            raise fault(folder, f"{len(data)} bytes of decoded data cannot be kept here ({error})", remedy) from error
        self._places[key] = start, len(data)

    def get(self, key: Hashable) -> bytes:
        start, length = self._places[key]
        return os.pread(self._opened().fileno(), length, start)

    def _opened(self) -> BinaryIO:
        if self._file is None:
            # Open as long as this object lives.
            self._file = tempfile.TemporaryFile(prefix="sparsestreet-")  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        return self._file
