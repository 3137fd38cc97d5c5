"""Writes small models in ONNX's format, byte by byte: the numbers are those of the fields in onnx.proto."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

FLOAT, FLOAT16, INT64 = 1, 10, 7
_INT, _INTS = 2, 7
Value = int | str | bytes
Shape = Sequence[int | str]


def node(op: str, inputs: Sequence[str], output: str, **attributes: int | Sequence[int]) -> bytes:
    return message(
        *((1, name) for name in inputs), (2, output), (4, op), *((5, _attribute(*one)) for one in attributes.items())
    )


def tensor(name: str, values: np.ndarray) -> bytes:
    kind = INT64 if values.dtype == np.int64 else FLOAT
    return message(*((1, size) for size in values.shape), (2, kind), (8, name), (9, values.tobytes()))


def write_model(
    path: Path,
    nodes: Iterable[bytes],
    tensors: Iterable[bytes],
    inputs: Iterable[tuple[str, int, Shape]],
    outputs: Iterable[tuple[str, int, Shape]],
) -> Path:
    """Inputs and outputs: name, type, sides, of which a word leaves one open."""
    graph = message(
        *((1, one) for one in nodes),
        (2, "tiny"),
        *((5, one) for one in tensors),
        *((11, _value(*one)) for one in inputs),
        *((12, _value(*one)) for one in outputs),
    )
    path.write_bytes(message((1, 8), (7, graph), (8, message((2, 13)))))
    return path


def message(*fields: tuple[int, Value]) -> bytes:
    """Varints for numbers; lengths before text, bytes and messages."""
    parts = []
    for number, value in fields:
        if isinstance(value, int):
            parts.append(_varint(number << 3) + _varint(value))
        else:
            content = value.encode() if isinstance(value, str) else value
            parts.append(_varint(number << 3 | 2) + _varint(len(content)) + content)
    return b"".join(parts)


def _varint(value: int) -> bytes:
    low, high = value & 127, value >> 7
    return bytes([low | 128]) + _varint(high) if high else bytes([low])


def _attribute(name: str, value: int | Sequence[int]) -> bytes:
    if isinstance(value, int):
        return message((1, name), (3, value), (20, _INT))
    return message((1, name), *((8, one) for one in value), (20, _INTS))


def _value(name: str, kind: int, shape: Shape) -> bytes:
    sides = message(*((1, message((1 if isinstance(side, int) else 2, side))) for side in shape))
    return message((1, name), (2, message((1, message((1, kind), (2, sides))))))
