"""A command in a process of its own, forked from this one: to import torch again would take most of the time."""

import os
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import jaxtyping
import torch

from sparsestreet.cli import main

LIMIT = 300.0
"""Seconds after which a command counts as one that hangs, on a machine that others load."""
HANGS = -1
"""Status of a command that had to be ended."""


@dataclass(frozen=True)
class Ended:
    """How a command came to its end."""

    status: int
    """Of the program; minus the number of the signal that ended it, HANGS for one that did not end."""
    said: str
    """What it wrote, errors included."""
    seconds: float
    grown_mb: float
    """Most memory that it held, less that of this process when it was forked."""

    @property
    def lines(self) -> list[str]:
        return self.said.splitlines()


class Forked:
    """A piece of work that was started; a group of processes of its own."""

    def __init__(
        self,
        work: Callable[[], object],
        log: Path,
        *,
        more_mb: int | None = None,
        cores: Collection[int] | None = None,
    ) -> None:
        """
        Args:
            work: what the process does; its status is 0 unless it raises SystemExit or fails.
            log: where what it writes is kept.
            more_mb: memory that it may reserve beyond what this process holds.
            cores: which it may use.
        """
        self._log, self._started, self._before = log, time.monotonic(), resident_mb()
        log.parent.mkdir(parents=True, exist_ok=True)
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid == 0:
            _become(work, log, more_mb, cores)

    def join(self, limit: float = LIMIT, kill_after: float | None = None) -> Ended:
        """Wait for its end. ``kill_after``: seconds after which all of its processes are killed (SIGKILL)."""
        until = self._started + (limit if kill_after is None else kill_after)
        while not (found := os.wait4(self.pid, os.WNOHANG))[0]:
            if time.monotonic() > until:
                # Its group is there as soon as it runs: a process just forked has none of its own.
                (os.killpg if os.getpgid(self.pid) == self.pid else os.kill)(self.pid, signal.SIGKILL)
                found = os.wait4(self.pid, 0)
                break
            time.sleep(0.002)
        _, status, usage = found
        code = os.waitstatus_to_exitcode(status)
        hung = kill_after is None and code == -signal.SIGKILL and time.monotonic() > until
        return Ended(
            HANGS if hung else code,
            self._log.read_text(errors="replace") if self._log.exists() else "",
            time.monotonic() - self._started,
            usage.ru_maxrss / 1024 - self._before,
        )


def command(words: Sequence[str], log: Path, *, more_mb: int | None = None, limit: float = LIMIT) -> Ended:
    """``sparsestreet`` with these words, to its end."""
    return Forked(lambda: main(list(words)), log, more_mb=more_mb).join(limit)


def _become(work: Callable[[], object], log: Path, more_mb: int | None, cores: Collection[int] | None) -> None:
    """What a user would have started, in the process that was forked; never returns."""
    status = 1
    try:
        os.setsid()
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        sys.stdout = sys.__stdout__ = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115 (until its end)
        sys.stderr = sys.__stderr__ = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
        torch.set_num_threads(1)  # those of the process that was forked are not there
        jaxtyping.config.update("jaxtyping_disable", True)
        warnings.resetwarnings()
        for unseen in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning, FutureWarning):
            warnings.simplefilter("ignore", unseen)
        if cores is not None:
            os.sched_setaffinity(0, cores)
        if more_mb is not None:
            most = _reserved_mb() + more_mb
            resource.setrlimit(resource.RLIMIT_AS, (most << 20, most << 20))
        work()
        status = 0
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _reserved_mb() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() >> 20


def resident_mb() -> float:
    """Memory that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20
