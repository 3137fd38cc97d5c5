"""What one process of a session (pytest-xdist) does for the others."""

from collections.abc import Generator
from pathlib import Path

import pytest
from filelock import FileLock


class CompiledOnce:
    """A plugin of the processes that run tests. The first session of a clone compiles all modules and tests, which
    takes longer than all else of collection: one process does, and the others find what it left."""

    def __init__(self, compiled: Path, lock: Path) -> None:
        self._compiled, self._lock = compiled, lock

    @pytest.hookimpl(wrapper=True)
    def pytest_collection(self) -> Generator[None, object, object]:
        if self._compiled.is_dir():
            return (yield)
        self._lock.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(self._lock):
            return (yield)
