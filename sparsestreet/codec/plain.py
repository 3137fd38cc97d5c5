"""Arrays of any meaning as bytes: bit for bit, or with a step."""

import numpy as np
from jaxtyping import Shaped

from sparsestreet.codec import integers
from sparsestreet.codec.reading import Cursor

INTEGERS = ("bool", "uint8", "int16", "int32", "int64")
"""Types that come back bit for bit, and as the same type."""
FLOATS = ("float16", "float32", "float64")
TYPES = INTEGERS + FLOATS


def packed_column(values: Shaped[np.ndarray, "n ..."], step: float | None = None) -> list[bytes]:
    """Returns the bytes of an array in pieces.

    With a step, each number is kept in whole steps. Raises ValueError for a type that is none of ``TYPES``.
    """
    if values.dtype.name not in TYPES:
        raise ValueError(f"arrays hold {', '.join(TYPES)}, got {values.dtype.name}")
    rows, width = len(values), int(np.prod(values.shape[1:], dtype=np.int64))
    table = np.ascontiguousarray(values).reshape(rows, width)
    if values.dtype.name in FLOATS and step is None:
        # Bytes of the same place together: those of the exponents are alike.
        planes = np.frombuffer(table.tobytes(), np.uint8).reshape(rows * width, values.dtype.itemsize)
        return [np.ascontiguousarray(planes.T).tobytes()]
    if step is not None:
        return integers.packed(np.rint(table / step).astype(np.int64))
    return integers.packed(table.astype(np.int64))


def unpacked_column(
    cursor: Cursor, rows: int, shape: tuple[int, ...], dtype: str, step: float | None = None
) -> Shaped[np.ndarray, "n ..."]:
    """Returns the array from where its bytes begin. Raises ValueError for damaged bytes or another type."""
    if dtype not in TYPES or (step is not None and dtype not in FLOATS):
        raise ValueError(f"arrays hold {', '.join(TYPES)}, got {dtype!r} with a step of {step}: it is damaged")
    width = int(np.prod(shape, dtype=np.int64))
    if dtype in FLOATS and step is None:
        size = np.dtype(dtype).itemsize
        planes = np.frombuffer(cursor.take(rows * width * size), np.uint8).reshape(size, rows * width)
        return np.frombuffer(planes.T.tobytes(), dtype).reshape(rows, *shape)
    table = integers.unpacked(cursor, rows, width)
    if step is not None:
        return (table * step).astype(dtype).reshape(rows, *shape)
    if rows and width and (table.astype(dtype) != table).any():
        raise ValueError(f"a number is no {dtype}: it is damaged")
    return table.astype(dtype).reshape(rows, *shape)
