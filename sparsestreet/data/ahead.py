"""Frames that are read before they are asked for."""

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial

import torch

from sparsestreet.data.device import Arriving, CopyStream
from sparsestreet.data.lazy import Frames
from sparsestreet.types import Frame

MOST_THREADS = 8
NAME = "frames"
"""What the threads' names begin with."""


class ReadAhead:
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
        self._threads = threads or min(torch.get_num_threads(), MOST_THREADS)
        self._stream = CopyStream(device) if device.type == "cuda" else None
        self._executors: list[ThreadPoolExecutor] = []
        """One thread, then all others."""
        self._pending: deque[Future[Frame | Arriving]] = deque()
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
        return frame.arrived() if isinstance(frame, Arriving) else frame

    def close(self) -> None:
        """Ends the threads; what they were reading is dropped. ``take`` starts new ones."""
        self._forget()
        executors, self._executors = self._executors, []
        if executors and self._process == os.getpid():
            for executor in executors:
                executor.shutdown(cancel_futures=True)
            # Threads to come have as many threads for a tensor as torch was told last, which was for ours.
            torch.set_num_threads(torch.get_num_threads())

    def _fetch(self, draw: int) -> Frame | Arriving:
        frame = self._read(draw)
        return frame if self._stream is None else self._stream.send(frame)

    def _start(self) -> None:
        if self._process != os.getpid():
            # A forked child has none of its parent's threads.
            self._executors, self._process = [], os.getpid()
            self._pending.clear()
        if not self._executors:
            # Each has one thread for a tensor: the others are for training.
            alone = partial(torch.set_num_threads, 1)
            self._executors = [
                ThreadPoolExecutor(count, thread_name_prefix=NAME, initializer=alone) for count in (1, self._threads)
            ]

    def _forget(self) -> None:
        for future in self._pending:
            future.cancel()
        self._pending.clear()


def read_ahead(frames: Frames, device: torch.device) -> Iterator[Frame]:
    """All frames in their order, once."""
    with closing(ReadAhead(frames.__getitem__, device)) as ahead:
        for place in range(len(frames)):
            yield ahead.take(place, len(frames))
