"""Frames from disk to a step: decoded once, packed in memory, read ahead by threads, copied to a GPU meanwhile."""

import os
import threading
import weakref
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from sparsestreet.types import MASK_KINDS, Camera, Frame

T = TypeVar("T")


def to_device(value: T, device: torch.device) -> T:
    """A copy of a frozen dataclass with all tensors, nested ones too, on the device; those of a camera stay.

    The host does not wait for the copies to a GPU: they go through pinned memory.
    """
    return _moved(value, device)


def _moved(value: Any, device: torch.device) -> Any:
    if isinstance(value, torch.Tensor):
        pinned = value.pin_memory() if device.type == "cuda" and value.device.type == "cpu" else value
        return pinned.to(device, non_blocking=True)
    if isinstance(value, Camera) or not is_dataclass(value) or isinstance(value, type):
        return value
    return replace(value, **{field.name: _moved(getattr(value, field.name), device) for field in fields(value)})


_SYSTEM = Path("/proc/meminfo")
_OWN_GROUPS = Path("/proc/self/cgroup")


@dataclass(frozen=True)
class _Groups:
    """Where Linux keeps the limits of groups of processes, such as the jobs of SLURM: Control Group v2, or v1."""

    prefix: str
    """Of the line of ``_OWN_GROUPS`` with this process's group."""
    root: Path
    limit: str
    used: str
    files: str
    """Entry of memory.stat: bytes of files that the system remembers, and forgets where memory is asked for."""


_V2 = _Groups("0::", Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file")
_V1 = _Groups(
    "memory:", Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
)


def free_bytes() -> int | None:
    """Bytes that the machine, and the job or container that this process belongs to, have free; files that the system
    remembers count as free. None: the system does not tell (it is not Linux)."""
    try:
        free = 1024 * _entries(_SYSTEM)["MemAvailable:"]
    except (OSError, KeyError):
        return None
    return min([free, *_free_of(_V2), *_free_of(_V1)])


def _free_of(groups: _Groups) -> list[int]:
    """Of each group with a limit that holds this process; none where the system has no such groups."""
    try:
        lines = _OWN_GROUPS.read_text().splitlines()
    except OSError:
        return []
    own = [line.partition(groups.prefix)[2] for line in lines if groups.prefix in line]
    # In a container the path may be that of the host: the root is then its own group.
    inner = groups.root / own[0].lstrip("/") if own else groups.root
    found = [_free_of_group(groups, at) for at in (inner, *inner.parents) if at.is_relative_to(groups.root)]
    return [free for free in found if free is not None]


def _free_of_group(groups: _Groups, at: Path) -> int | None:
    try:
        limit = (at / groups.limit).read_text().strip()
        if limit == "max":
            return None
        used = int((at / groups.used).read_text())
        return max(int(limit) - used + _entries(at / "memory.stat")[groups.files], 0)
    except (OSError, KeyError, ValueError):
        return None


def _entries(path: Path) -> dict[str, int]:
    """Name -> number, of a file with one of each a line."""
    return {name: int(number) for name, number, *_ in map(str.split, path.read_text().splitlines())}


class Lock:
    """``with Lock():`` one thread at a time."""

    def __init__(self) -> None:
        self.open()
        _all.add(self)

    def open(self) -> None:
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *exception: object) -> None:
        self._lock.release()


def _open_all() -> None:
    for lock in list(_all):
        lock.open()


_all: "weakref.WeakSet[Lock]" = weakref.WeakSet()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_open_all)


@dataclass(frozen=True)
class PackedFrame:
    """All of a frame, bit for bit. At 960x640 it takes 2.4 MB where a frame with four masks and a depth takes 6.8."""

    bare: Frame
    """With its image, without masks and depth."""
    masks: tuple[str, ...]
    bits: UInt8[np.ndarray, " b"]
    """Of the masks one after the other. They are unpacked by one call, because a thread that takes the interpreter's
    lock back after each of many calls keeps it from the thread that trains."""
    depth: "Float[Tensor, 'h w'] | Returns | None"

    @staticmethod
    def of(frame: Frame) -> "PackedFrame":
        masks = {name: mask.numpy() for name in MASK_KINDS if (mask := getattr(frame, name)) is not None}
        bits = np.packbits(np.stack(list(masks.values()))) if masks else np.zeros(0, np.uint8)
        none: dict[str, None] = dict.fromkeys((*MASK_KINDS, "depth"))
        depth = None if frame.depth is None else Returns.of(frame.depth)
        return PackedFrame(replace(frame, **none), tuple(masks), bits, depth)

    @property
    def nbytes(self) -> int:
        return self.bare.image.nbytes + self.bits.nbytes + (0 if self.depth is None else self.depth.nbytes)

    def frame(self) -> Frame:
        """The frame. Its masks and its depth are new, its image is shared by all who ask."""
        height, width, _ = self.bare.image.shape
        masks = torch.from_numpy(np.unpackbits(self.bits, count=len(self.masks) * height * width).view(np.bool_))
        planes = masks.view(len(self.masks), height, width)
        depth = self.depth.image((height, width)) if isinstance(self.depth, Returns) else self.depth
        return replace(self.bare, depth=depth, **dict(zip(self.masks, planes, strict=True)))


@dataclass(frozen=True)
class Returns:
    """The pixels of a depth that are not 0."""

    places: Int32[Tensor, " n"]
    """Of the pixels in row-major order."""
    values: Float[Tensor, " n"]

    @staticmethod
    def of(depth: Float[Tensor, "h w"]) -> "Float[Tensor, 'h w'] | Returns":
        """The depth itself where its returns would take no less."""
        flat = depth.reshape(-1)
        places = ((flat != 0) | flat.signbit()).nonzero()[:, 0].int()  # a -0 too: every bit counts
        found = Returns(places, flat[places])
        return found if found.nbytes < depth.nbytes else depth

    @property
    def nbytes(self) -> int:
        return self.places.nbytes + self.values.nbytes

    def image(self, size: tuple[int, int]) -> Float[Tensor, "h w"]:
        depth = torch.zeros(size, dtype=self.values.dtype)
        depth.view(-1)[self.places] = self.values
        return depth


CacheSize = int | Literal["auto"]
"""MB (1e6 bytes) of decoded frames in memory; auto: the whole log, while as much memory as it takes stays free."""
FALLBACK_BYTES = 4_000_000_000
"""Bytes that ``auto`` takes at most where the system does not tell what is free."""


def cache_bytes(megabytes: CacheSize) -> int | None:
    """What a reader's setting means to ``FrameCache``; raises ValueError for anything but a size."""
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


class FrameCache:
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
        if self._typical <= self._free():
            self._keep(key, PackedFrame.of(frame))
        return frame

    def __len__(self) -> int:
        return len(self._kept)

    def forecast(self, keys: Sequence[Hashable]) -> MemoryForecast:
        """What will be kept of the frames of these keys, judged by the one that was read last, or now by the first."""
        if not self._typical:
            self(keys[0])
        total, size = len(keys), max(self._typical, 1)
        count = min(total, len(self) + max(self._free(), 0) // size)
        return MemoryForecast(count, total, count * size, total * size)

    def _keep(self, key: Hashable, packed: PackedFrame) -> None:
        with self._lock:
            self._typical = packed.nbytes
            if key not in self._kept and packed.nbytes <= self._free():
                self._kept[key] = packed
                self._used += packed.nbytes

    def _free(self) -> int:
        """Bytes that may still be taken."""
        if self._room is not None:
            return self._room - self._used
        free = free_bytes()
        return FALLBACK_BYTES - self._used if free is None else (free - self._used) // 2


MAX_THREADS = 8
THREAD_NAME = "frames"
"""What the threads' names begin with."""


@dataclass(frozen=True)
class ArrivingFrame:
    """A frame whose copy to a GPU may still be under way."""

    frame: Frame
    done: torch.cuda.Event

    def wait(self) -> Frame:
        """The frame, for work that the current stream of its device is given from now on. The host does not wait."""
        stream = torch.cuda.current_stream(self.frame.image.device)
        stream.wait_event(self.done)
        for tensor in _tensors(self.frame):
            # Its memory belongs to the stream that copied it, and is not to be reused before this one is done.
            tensor.record_stream(stream)
        return self.frame


def _tensors(frame: Frame) -> Iterator[torch.Tensor]:
    values = (getattr(frame, field.name) for field in fields(frame))
    return (value for value in values if isinstance(value, torch.Tensor))


class Prefetcher:
    """The frames of a stream of draws, in their order, each read by a thread while earlier ones are trained on.

    Pillow, NumPy and torch release the interpreter's lock where they work long, so threads read at the same time. On a
    GPU the frames that are read lie there before they are taken. Threads start with the first frame, and end with
    ``close``.

    While one thread keeps up, as it does with frames that are in memory, it reads alone. On a busy machine threads that
    took turns cost the training 0.7 ms a step, one costs 0.05 ms (docs/scaling.md).
    """

    def __init__(self, read: Callable[[int], Frame], device: torch.device, threads: int | None = None) -> None:
        """
        Args:
            read: makes the frame of a draw, which are counted from 0; threads call it.
            device: where frames are wanted.
            threads: that read; None: as many as this process has for its tensors (torch's), but at most 8.
        """
        if threads is not None and threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._read = read
        self._threads = threads or min(torch.get_num_threads(), MAX_THREADS)
        self._device = device
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        """Frames travel on it while a step computes."""
        self._executors: list[ThreadPoolExecutor] = []
        """One thread, then all others."""
        self._pending: deque[Future[Frame | ArrivingFrame]] = deque()
        self._next = 0
        self._process = os.getpid()

    def take(self, draw: int, end: int | None = None) -> Frame:
        """The frame of a draw; those that follow it, up to ``end``, are read meanwhile. Raises what ``read`` raised."""
        self._start()
        if draw != self._next:
            self._forget()
            self._next = draw
        ahead = self._threads + 1 if end is None else min(self._threads + 1, end - draw)
        while len(self._pending) < ahead:
            behind = any(not future.done() for future in self._pending)
            self._pending.append(self._executors[behind].submit(self._fetch, draw + len(self._pending)))
        self._next += 1
        frame = self._pending.popleft().result()
        return frame.wait() if isinstance(frame, ArrivingFrame) else frame

    def close(self) -> None:
        """Ends the threads; what they were reading is dropped. ``take`` starts new ones."""
        self._forget()
        executors, self._executors = self._executors, []
        if executors and self._process == os.getpid():
            for executor in executors:
                executor.shutdown(cancel_futures=True)
            # Threads to come have as many threads for a tensor as torch was told last, which was for ours.
            torch.set_num_threads(torch.get_num_threads())

    def _fetch(self, draw: int) -> Frame | ArrivingFrame:
        frame = self._read(draw)
        if self._stream is None:
            return frame
        done = torch.cuda.Event()
        with torch.cuda.stream(self._stream):
            moved = to_device(frame, self._device)
            done.record(self._stream)
        return ArrivingFrame(moved, done)

    def _start(self) -> None:
        if self._process != os.getpid():
            # A forked child has none of its parent's threads.
            self._executors, self._process = [], os.getpid()
            self._pending.clear()
        if not self._executors:
            # Each has one thread for a tensor: the others are for training.
            alone = partial(torch.set_num_threads, 1)
            self._executors = [
                ThreadPoolExecutor(count, thread_name_prefix=THREAD_NAME, initializer=alone)
                for count in (1, self._threads)
            ]

    def _forget(self) -> None:
        for future in self._pending:
            future.cancel()
        self._pending.clear()


def prefetched(frames: Sequence[Frame], device: torch.device) -> Iterator[Frame]:
    """All frames in their order, once."""
    with closing(Prefetcher(frames.__getitem__, device)) as ahead:
        for place in range(len(frames)):
            yield ahead.take(place, len(frames))
