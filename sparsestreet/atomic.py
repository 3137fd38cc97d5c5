"""Files and folders that appear whole or not at all, and locks that the kernel releases when their process dies.

A reader never sees half of a file; a crash leaves the old one.
"""

import errno
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_SAID = ("os error 28", "os error 27", "os error 122", "iostream error", "unexpected pos", "file write failed")
"""What safetensors (numbers of the system) and torch say, whose errors are none of the system's."""


def check_regular(path: Path) -> None:
    """Raise OSError for a pipe, a socket or a device, by a link too: who opens one may wait for ever.

    What is not there is no matter of this check.

    >>> check_regular(Path("/dev/null"))
    Traceback (most recent call last):
    OSError: /dev/null is a pipe, a socket or a device, and no file: put the file itself in its place
    """
    mode = path.stat().st_mode if path.exists() else stat.S_IFREG
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(f"{path} is a pipe, a socket or a device, and no file: put the file itself in its place")


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``. Its file replaces ``path`` at the end, or goes if the block fails.

    A block that writes nothing changes nothing. When several processes save together, only the first writes; the others
    enter the block too (``Trainer.save_checkpoint`` must be called by all), and change nothing.

    Raises OSError before the block if nothing can be written, and where the disk is full, whatever the writer raised.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with atomic_file(Path(folder, "note.txt")) as file:
    ...         _ = file.write_text("whole")
    ...     [path.name for path in Path(folder).iterdir()]
    ['note.txt']
    """
    # The suffix stays, because some writers choose the format by it.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    with writable(path):
        if path.is_dir():
            raise IsADirectoryError(0, "it is a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        mode = temporary.stat().st_mode
        temporary.unlink()
    with _whole(path, lambda: temporary.unlink(missing_ok=True)):
        yield temporary
        if temporary.exists():
            # Some writers (safetensors) leave a file that only its owner may read.
            temporary.chmod(mode)
            os.replace(temporary, path)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder next to ``path``. It becomes ``path`` when the block ends, and is deleted if it fails.

    Raises OSError before the block if nothing can be written, or if ``path`` is not an empty folder.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as parent:
    ...     with atomic_folder(Path(parent, "run")) as folder:
    ...         (folder / "log.txt").touch()
    ...     [path.name for path in Path(parent, "run").iterdir()]
    ['log.txt']
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with writable(path):
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise FileExistsError(0, "it exists and is no empty folder")
        temporary.mkdir(parents=True)
    with _whole(path, lambda: shutil.rmtree(temporary, ignore_errors=True)):
        yield temporary
        if path.is_dir():
            path.rmdir()
        os.replace(temporary, path)


@contextmanager
def writable(path: Path) -> Iterator[None]:
    """Say of an OSError of the block that ``path`` cannot be written, and why.

    >>> with writable(Path("there")):
    ...     raise PermissionError(13, "Permission denied")
    Traceback (most recent call last):
    OSError: there cannot be written (Permission denied)...
    """
    try:
        yield
    except OSError as error:
        raise OSError(f"{path} cannot be written ({error.strerror}): name another place") from error


@contextmanager
def _whole(path: Path, remove: Callable[[], object]) -> Iterator[None]:
    """Remove what is half written however the block ends; an error of a full disk says so."""
    try:
        yield
    except Exception as error:
        remove()
        if _is_full(error):
            raise _full(path, error) from error
        raise
    finally:
        remove()


def _is_full(error: Exception) -> bool:
    """Whether a file could not be written because the disk, or the share of its user, is full."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in _FULL
    return any(words in str(error) for words in _SAID)


def _full(path: Path, error: Exception) -> OSError:
    folder = next(one for one in (path, *path.absolute().parents) if one.is_dir())
    free = shutil.disk_usage(folder).free
    reason = error.strerror if isinstance(error, OSError) else str(error).splitlines()[0]
    return OSError(
        f"{path} cannot be written ({reason}): {free / 1e6:,.1f} MB are free there. What stood there before is whole; "
        "make room and repeat the command"
    )


def acquire_lock(path: Path) -> int | None:
    """Take the lock of a file, which is made; answers at once with its descriptor, None where somebody else holds it.

    Raises OSError where the file cannot be made.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     held = acquire_lock(Path(folder) / "lock")
    ...     acquire_lock(Path(folder) / "lock") is None
    ...     release_lock(Path(folder) / "lock", held)
    True
    """
    import fcntl  # Windows has none

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


def release_lock(path: Path, descriptor: int) -> None:
    """Remove the file and give its lock up.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "lock"
    ...     release_lock(path, acquire_lock(path))
    ...     path.exists()
    False
    """
    if _is_there(path, descriptor):
        path.unlink()
    os.close(descriptor)


def _is_there(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
