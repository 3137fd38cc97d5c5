"""A lock that a forked child finds open, whoever held it in the parent."""

import os
import threading
import weakref


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
