"""Locks that the kernel releases when their process dies, however it dies."""

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOCK = ".lock"
"""In the folder of a run that is being written."""


class FolderTakenError(OSError):
    """Another process writes into the folder of a run."""


@contextmanager
def sole_writer(out: Path) -> Iterator[None]:
    """Nobody else writes into a run's folder while the block runs.

    Where the folder lies on NFS, computers see each other's locks only as far as its server hands them on.

    Raises FolderTakenError, naming who writes there, where somebody else does; nothing is touched then.
    """
    path = out / LOCK
    out.mkdir(parents=True, exist_ok=True)
    held = acquire(path)
    if held is None:
        raise FolderTakenError(
            f"{out} is being written by {_holder(path)}: wait for that run, end it, or name another place with out=..."
        )
    try:
        os.truncate(held, 0)
        os.write(held, f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        release(path, held)


def acquire(path: Path) -> int | None:
    """Take the lock of a file, which is made; answers at once with its descriptor, None where somebody else holds it.

    Raises OSError where the file cannot be made.
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        if _is_there(path, descriptor):
            return descriptor
        os.close(descriptor)  # whoever held it removed the file in between


def release(path: Path, descriptor: int) -> None:
    """Remove the file and give its lock up."""
    if _is_there(path, descriptor):
        path.unlink()
    os.close(descriptor)


def _is_there(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _holder(path: Path) -> str:
    try:
        return path.read_text() or "another process"
    except OSError:
        return "another process"
