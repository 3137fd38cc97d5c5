"""What this process is: how it takes memory and waits for its threads, and whether it is one of several of a run.

Memory and threads are said before torch is imported, which reads them once.
"""

import ctypes
import logging
import os
import select
import statistics
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
"""Of glibc's mallopt (malloc.h)."""

SPINS, BUSY_SPINS = "10000", "0"
"""Looks at a barrier before a thread of libgomp sleeps there, some hundreds of microseconds at most; and those where
others need the processors."""
_RUNNING = Path("/proc/loadavg")
_SAMPLES, _PAUSE = 9, 0.005
"""How often, and seconds apart, the system is asked who runs: a process that starts beside ours is no load."""


def prepare_process() -> None:
    """Keep freed memory, and sleep instead of spinning; what the environment says of either stays as it is."""
    keep_freed_memory()
    use_passive_wait()


def stdout_closed() -> bool:
    """Whether the reader of our output has enough (``| head``): the pipe is broken, by its state and not by an error.

    Where there is no such question to ask (Windows, output that is no file), nobody is said to read.
    """
    if not hasattr(select, "poll"):
        return True
    try:
        pipe = sys.stdout.fileno()
    except (OSError, ValueError):
        return True
    poll = select.poll()
    poll.register(pipe, 0)  # errors are told in any case
    return bool(poll.poll(0))


def keep_freed_memory() -> None:
    """Let freed memory stay with the process, where the C library is glibc.

    A training step frees and takes the same hundred megabytes again. By default glibc gives large blocks back to the
    system at once, which then clears them page by page when they are taken again: thousands of page faults a step
    (docs/scaling.md).
    """
    if not sys.platform.startswith("linux") or any(name.startswith("MALLOC_") for name in os.environ):
        return
    libc = ctypes.CDLL(None)
    if hasattr(libc, "gnu_get_libc_version"):
        libc.mallopt(_MMAP_MAX, 0)
        libc.mallopt(_TRIM_THRESHOLD, -1)


def use_passive_wait() -> None:
    """Let threads that wait for each other sleep after a moment, or at once where other processes run.

    By default libgomp's threads look at a barrier hundreds of thousands of times, for milliseconds. Where another
    process has the processor that the other thread needs, they only keep it from running: a step of two threads took
    seven times the processor's time, a third more with ``SPINS``, and as much as of one thread with ``BUSY_SPINS``
    (docs/scaling.md).
    """
    if "OMP_WAIT_POLICY" not in os.environ and "GOMP_SPINCOUNT" not in os.environ:
        os.environ["GOMP_SPINCOUNT"] = SPINS if _processors_do() else BUSY_SPINS


def _processors_do() -> bool:
    """Whether there are processors for our threads beside what runs now; True where the system does not say."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    processors = os.cpu_count() or 1
    threads = int(given) if given.isdecimal() else processors
    try:
        others = [_others_running() for _ in range(_SAMPLES)]
    except (OSError, IndexError, ValueError):
        return True
    return threads == 1 or statistics.median(others) + threads <= processors


def _others_running() -> int:
    """Threads of other processes that run or wait for a processor, after a pause."""
    time.sleep(_PAUSE)
    return int(_RUNNING.read_text().split()[3].partition("/")[0]) - 1


def shares_a_run(trainer: Mapping[str, Any]) -> bool:
    """Whether several processes train one scene."""
    return trainer.get("strategy") not in (None, "auto")


def is_worker_rank(trainer: Mapping[str, Any]) -> bool:
    """Whether this process is one of those that a run's first one, or the cluster, started beside it."""
    return name_beside_first(trainer) is not None


def name_beside_first(trainer: Mapping[str, Any]) -> str | None:
    """What a process is called that another one of its run goes before; None for the first one, and alone.

    >>> name_beside_first({"strategy": "auto"}) is None
    True
    """
    given = {name: os.environ.get(name, "0") for name in ("RANK", "SLURM_PROCID", "NODE_RANK", "LOCAL_RANK")}
    if not shares_a_run(trainer) or set(given.values()) == {"0"}:
        return None
    of_all = next((given[name] for name in ("RANK", "SLURM_PROCID") if given[name] != "0"), None)
    if of_all is not None:  # torchrun and SLURM count over all nodes, Lightning on each
        return f"process {of_all}"
    node = "" if given["NODE_RANK"] == "0" else f" of node {given['NODE_RANK']}"
    return f"process {given['LOCAL_RANK']}{node}"


def set_log_prefix(name: str) -> None:
    """Let this process, which others of its run go before, say nothing but warnings and errors, and who it is.

    The first says what all of them do.
    """
    for handler in logging.getLogger().handlers:
        handler.addFilter(_Named(name))
    for library in ("lightning.fabric", "lightning.pytorch"):
        logging.getLogger(library).setLevel(logging.WARNING)
    logging.captureWarnings(True)


class _Named(logging.Filter):
    """Of a handler: lets warnings pass, with the name of the process in front."""

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return False
        if not getattr(record, "named", False):  # of another handler
            record.msg, record.named = f"{self.name}: {record.msg}", True
        return True
