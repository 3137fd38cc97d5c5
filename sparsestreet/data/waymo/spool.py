"""What was decoded once and may be asked for again, in a file without a name that ends with the process."""

import os
import tempfile
from collections.abc import Hashable
from pathlib import Path

from sparsestreet.data.problems import fault


class Spool:
    """Bytes by key. They go to the folder for temporary files (TMPDIR), not to memory."""

    def __init__(self) -> None:
        self._file: tempfile._TemporaryFileWrapper | None = None
        self._places: dict[Hashable, tuple[int, int]] = {}
        self._end = 0

    def __contains__(self, key: Hashable) -> bool:
        return key in self._places

    def put(self, key: Hashable, data: bytes) -> None:
        """Raises LogError where the folder has no room."""
        try:
            if self._file is None:
                # Open as long as this object lives.
                self._file = tempfile.TemporaryFile(prefix="sparsestreet-")  # noqa: SIM115
            done = 0
            while done < len(data):
                done += os.pwrite(self._file.fileno(), data[done:], self._end + done)
        except OSError as error:
            message = f"{len(data)} bytes of decoded data cannot be kept here ({error})"
            raise fault(
                Path(tempfile.gettempdir()), message, "make room, or set TMPDIR to a folder with room"
            ) from error
        self._places[key] = self._end, len(data)
        self._end += len(data)

    def get(self, key: Hashable) -> bytes:
        start, length = self._places[key]
        if self._file is None:
            raise KeyError(key)
        return os.pread(self._file.fileno(), length, start)
