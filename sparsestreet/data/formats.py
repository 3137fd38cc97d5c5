"""Data sets as their publishers ship them: told by their files, to be named where they cannot be read."""

from pathlib import Path

_MARKS = {
    "nuScenes tables": ("sample_data.json", "*/sample_data.json"),
    "Waymo's recordings (.tfrecord)": ("*.tfrecord", "*/*.tfrecord"),
    "Waymo's recordings, version 2 (.parquet)": ("*.parquet", "*/*.parquet", "*/*/*.parquet"),
    "KITTI's raw data": ("image_02/data", "*/image_02/data"),
}


def published_format(path: Path) -> str | None:
    """Which publisher's format a file or folder holds, in words, and the file that tells; None where none is known."""
    for words, patterns in _MARKS.items():
        if path.is_file() and any(path.match(pattern) for pattern in patterns if "/" not in pattern):
            return words
        found = next((mark for pattern in patterns for mark in path.glob(pattern)), None)
        if found is not None:
            return f"{words}, as {found.relative_to(path)} tells"
    return None
