"""Messages with values that nobody would send."""

from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor as Field

_FLOATS = (float("nan"), float("inf"), -float("inf"), -1.0, 0.0, 1e-30, 1e30, 3.0e38)
_WHOLE = (0, 1, 2, 7, 63, 8193, 1_000_000, 2**31 - 1)
_SIGNED = (-1, -(2**31))
_UNSIGNED = (2**32 - 1,)
_LONG = (2**63, 2**64 - 1)
_TEXTS = ("", "nobody", "*", "../..", "x" * 5000, "\u0000", "ä" * 300)
_SIGNED_TYPES = (Field.CPPTYPE_INT32, Field.CPPTYPE_INT64)
_FLOAT_TYPES = (Field.CPPTYPE_FLOAT, Field.CPPTYPE_DOUBLE)


def spoiled(message: Any, rng: np.random.Generator) -> Any:
    """The message with wrong values in one to four of its fields, at any depth; the message itself is changed."""
    for _ in range(int(rng.integers(1, 5))):
        _spoil(message, rng)
    return message


def _spoil(message: Any, rng: np.random.Generator) -> None:
    fields = list(message.DESCRIPTOR.fields)
    field = fields[int(rng.integers(len(fields)))]
    inner = getattr(message, field.name)
    if field.cpp_type == Field.CPPTYPE_MESSAGE:
        if rng.random() < 0.15:
            message.ClearField(field.name)
        elif not field.is_repeated:
            inner.SetInParent()
            _spoil(inner, rng)
        else:
            _spoil(inner[int(rng.integers(len(inner)))] if len(inner) and rng.random() < 0.7 else inner.add(), rng)
    elif field.is_repeated:
        if len(inner) and rng.random() < 0.5:
            del inner[int(rng.integers(len(inner))) :]
        inner.extend([_value(field, rng) for _ in range(int(rng.integers(0, 9)))])
    else:
        setattr(message, field.name, _value(field, rng))


def _value(field: Any, rng: np.random.Generator) -> Any:
    kind = field.cpp_type
    if kind in _FLOAT_TYPES:
        return float(rng.choice(_FLOATS))
    if kind == Field.CPPTYPE_BOOL:
        return bool(rng.integers(2))
    if kind == Field.CPPTYPE_STRING:
        text = _TEXTS[int(rng.integers(len(_TEXTS)))]
        return text.encode() if field.type == Field.TYPE_BYTES else text
    if kind == Field.CPPTYPE_ENUM:
        return int(rng.integers(0, 12))
    wide = kind in (Field.CPPTYPE_INT64, Field.CPPTYPE_UINT64)
    choices = [*_WHOLE, *(_SIGNED if kind in _SIGNED_TYPES else _UNSIGNED)]
    choices += list(_LONG) if kind == Field.CPPTYPE_UINT64 else []
    number = choices[int(rng.integers(len(choices)))]
    return number * 10**6 if wide and abs(number) < 10**6 and rng.random() < 0.5 else number
