"""A sweep whose jobs run beside each other ends as one run does: every job saves at the end of its step.

joblib alone kills the processes of its jobs as soon as its own is interrupted, or one of them ends.
"""

import logging
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from hydra.conf import HydraConf
from omegaconf import DictConfig

from sparsestreet.cli.locks import hold, let_go

log = logging.getLogger(__name__)

Handler = Callable[[int, FrameType | None], None] | signal.Handlers

_ALL = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
SIGNALS = tuple(number for number in _ALL if signal.getsignal(number) is not signal.SIG_IGN)
"""Those of ``GracefulStop``; what this process was started to ignore (``nohup``) stays ignored."""


def beside_each_other(hydra: HydraConf | DictConfig) -> bool:
    """Whether the jobs of a sweep have processes of their own on this machine, and stay with it."""
    return "joblib" in hydra.launcher._target_


@contextmanager
def handlers_put_back() -> Iterator[None]:
    """Whatever handles signals within the block, they are as before behind it."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # one of another language
                signal.signal(number, handler)


def end_with_jobs(sweep: Path) -> None:
    """In the process of a sweep: hand what would end it to the jobs, wait until none runs, end with 128 + the number.

    Ctrl-C behind it ends the sweep at once.
    """

    def end(number: int, frame: FrameType | None) -> None:
        _take(signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        running = [child.pid for child in multiprocessing.active_children() if child.pid and _runs(sweep, child.pid)]
        log.warning("%d jobs save after their step; Ctrl-C from now on ends them at once", len(running))
        for pid in running:
            with suppress(ProcessLookupError):
                # Behind a Ctrl-C that has reached a job already, this one asks for nothing new.
                os.kill(pid, signal.SIGTERM)
        while any(_runs(sweep, pid) for pid in running):
            time.sleep(0.05)
        raise SystemExit(128 + number)

    for path in sweep.glob(".job*"):  # of jobs that were killed
        _is_held(path)
    _take(end)


@contextmanager
def job_beside_others(sweep: Path) -> Iterator[None]:
    """In the process of a job: it counts as running, and a signal raises SystemExit (training saves before)."""

    def end(number: int, frame: FrameType | None) -> None:
        _take(signal.SIG_IGN)
        raise SystemExit(128 + number)

    path = _sign(sweep, os.getpid())
    held = hold(path)
    _take(end)
    try:
        yield
    finally:
        # joblib would kill the other jobs if this process died between two of its own.
        _take(signal.SIG_IGN)
        if held is not None:
            let_go(path, held)


def _take(handler: Handler) -> None:
    for number in SIGNALS:
        signal.signal(number, handler)


def _sign(sweep: Path, pid: int) -> Path:
    return sweep / f".job{pid}"


def _runs(sweep: Path, pid: int) -> bool:
    path = _sign(sweep, pid)
    return path.exists() and _is_held(path)


def _is_held(path: Path) -> bool:
    """Whether a process lives that holds the file; it is removed where none does."""
    held = hold(path)
    if held is not None:
        let_go(path, held)
    return held is None
