"""Numbers from text files."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sparsestreet.data.problems import fault


def read_numbers(path: Path) -> Float64[np.ndarray, "rows columns"]:
    """The lines of numbers of a text file, empty ones left out; raises LogError where it is missing or no table."""
    if not path.is_file():
        raise fault(path, "the file is missing", "write it, or leave out its frame or camera")
    try:
        rows = [[float(number) for number in line.split()] for line in path.read_text().splitlines() if line.strip()]
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1 if rows else 0)
    except ValueError as error:
        raise fault(path, f"the file is no table of numbers ({error})", "write numbers separated by spaces") from error
