"""Decoded frames that stay in memory."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sparsestreet.data.free_memory import free_bytes
from sparsestreet.data.lock import Lock
from sparsestreet.data.packed import PackedFrame
from sparsestreet.types import Frame

CacheSize = int | Literal["auto"]
"""MB (1e6 bytes) of decoded frames in memory; auto: the whole log, while as much memory as it takes stays free."""
WITHOUT_A_WORD = 4_000_000_000
"""Bytes that ``auto`` takes at most where the system does not tell what is free."""


def cache_bytes(megabytes: CacheSize) -> int | None:
    """What a reader's setting means to ``KeptFrames``; raises ValueError for anything but a size."""
    if megabytes == "auto":
        return None
    if isinstance(megabytes, str) or megabytes < 0:
        raise ValueError(f"cache_mb must be a number of MB, 0 or more, or auto, got {megabytes!r}")
    return int(1_000_000 * megabytes)


@dataclass(frozen=True)
class MemoryForecast:
    """Which part of a log's frames stays in memory, once all of them were read."""

    kept: int
    total: int
    bytes_kept: int
    bytes_total: int

    def __str__(self) -> str:
        if self.kept == self.total:
            return f"all {self.total} frames stay in memory once they are decoded ({self.bytes_kept / 1e9:.2f} GB)"
        return (
            f"{self.kept} of {self.total} frames stay in memory once they are decoded ({self.bytes_kept / 1e9:.2f} of "
            f"{self.bytes_total / 1e9:.2f} GB), the others are decoded for each step that takes them: free memory, "
            "raise data.log.cache_mb or read smaller images"
        )


class KeptFrames:
    """What ``load`` makes of a key, decoded once while there is room. Threads may ask at the same time.

    Steps ask for all frames in turn, in a new order each time. So what was kept first stays: if what was used last
    made way, as in most caches, almost every frame would be gone before it is asked for again.
    """

    def __init__(self, load: Callable[[Any], Frame], room: int | None) -> None:
        """``room``: bytes of packed frames. None: as many as the machine has, while at least as many stay free; so
        of several processes with large logs each gets the same share."""
        self._load = load
        self._room = room
        self._kept: dict[Hashable, PackedFrame] = {}
        self._used = 0
        self._typical = 0
        """Bytes of the frame that was packed last."""
        self._lock = Lock()

    def __call__(self, key: Hashable) -> Frame:
        packed = self._kept.get(key)
        if packed is not None:
            return packed.frame()
        frame = self._load(key)
        if self._typical <= self._left():
            self._keep(key, PackedFrame.of(frame))
        return frame

    def __len__(self) -> int:
        return len(self._kept)

    def forecast(self, keys: Sequence[Hashable]) -> MemoryForecast:
        """What will be kept of the frames of these keys, judged by the one that was read last, or now by the first."""
        if not self._typical:
            self(keys[0])
        total, size = len(keys), max(self._typical, 1)
        count = min(total, len(self) + max(self._left(), 0) // size)
        return MemoryForecast(count, total, count * size, total * size)

    def _keep(self, key: Hashable, packed: PackedFrame) -> None:
        with self._lock:
            self._typical = packed.nbytes
            if key not in self._kept and packed.nbytes <= self._left():
                self._kept[key] = packed
                self._used += packed.nbytes

    def _left(self) -> int:
        """Bytes that may still be taken."""
        if self._room is not None:
            return self._room - self._used
        free = free_bytes()
        return WITHOUT_A_WORD - self._used if free is None else (free - self._used) // 2
