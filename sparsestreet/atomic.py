"""Files and folders that appear whole or not at all: a reader never sees half of one, a crash leaves the old one."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A file to write beside ``path``; it takes its place when the block ends, and goes when the block fails.

    A block that writes nothing changes nothing: of several processes that save together, the first writes and the
    others come here with nothing to say (``Trainer.save_checkpoint`` must be called by all).

    Raises OSError before the block where nothing can be written.
    """
    # The ending stays, because some writers choose the format by it.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        if path.is_dir():
            raise IsADirectoryError(0, "it is a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        mode = temporary.stat().st_mode
        temporary.unlink()
    except OSError as error:
        raise _unwritable(path, error) from error
    try:
        yield temporary
        if temporary.exists():
            # Some writers (safetensors) leave a file that only its owner may read.
            temporary.chmod(mode)
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """A folder to fill beside ``path``; it takes its place when the block ends, and goes when the block fails.

    Raises OSError before the block where nothing can be written, or where ``path`` holds something already.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise FileExistsError(0, "it exists and is no empty folder")
        temporary.mkdir(parents=True)
    except OSError as error:
        raise _unwritable(path, error) from error
    try:
        yield temporary
        if path.is_dir():
            path.rmdir()
        os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _unwritable(path: Path, error: OSError) -> OSError:
    return OSError(f"{path} cannot be written ({error.strerror}): name another place")
