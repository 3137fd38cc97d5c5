"""Reads arrays from pickles of others without running anything in them.

Unpickling normally calls what the file names. Here a name that describes arrays of numbers becomes a stand-in that
calls
nothing; any other name is refused. After reading, the stand-ins are turned into arrays.
"""

import io
import math
import pickle
import re
import struct
import sys
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np
import torch

from sparsestreet.atomic import check_regular


def read_pickled(path: Path) -> Any:
    """Reads dicts, lists, numbers, text and arrays of numbers from a pickle, or from joblib's without compression.

    Tensors of torch, sparse matrices of scipy and arrays wrapped by chumpy become plain NumPy arrays. Raises
    FileNotFoundError, or ValueError, naming the file, if it holds anything else.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "array.pkl")
    ...     _ = path.write_bytes(pickle.dumps({"means": np.arange(3)}))
    ...     read_pickled(path)
    {'means': array([0, 1, 2])}
    """
    check_regular(path)
    with path.open("rb") as file:
        try:
            return _worked_out(_Reader(file, _KNOWN).load())
        except Exception as error:  # each opcode of a broken pickle fails in its own way
            reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            raise ValueError(
                f"{path} must be a pickle of plain values and arrays of numbers, which it is not ({reason}): "
                "write it again with nothing else in it, and without compression"
            ) from error


def unpickled(content: bytes, names: Collection[str], *, max_steps: int) -> Any:
    """What a pickle holds, with stand-ins for all that it names and makes.

    Args:
        content: the pickle; its length bounds that of text and bytes.
        names: what it may name beside arrays of numbers, such as "pandas.core.frame.DataFrame".
        max_steps: of the unpickler, which bounds time and memory: a step of one byte may make an object of 200.

    Raises ValueError, or whatever a step of a broken pickle fails with.

    >>> found = unpickled(pickle.dumps(range(3)), ["builtins.range"], max_steps=100)
    >>> found.name, found.arguments
    ('builtins.range', (0, 3, 1))
    """
    reader = _Reader(io.BytesIO(content), {*_OF_NUMPY, *names})
    reader.dispatch = _Counted(reader.dispatch, max_steps)  # pyright: ignore[reportAttributeAccessIssue]
    return reader.load()


def array_of_numbers(made: "Made") -> np.ndarray:
    """The array of a stand-in. Raises ValueError for one of something else.

    >>> array_of_numbers(unpickled(pickle.dumps(np.arange(3)), (), max_steps=100))
    array([0, 1, 2])
    """
    if not isinstance(made, Made) or made.name not in _ARRAYS:
        raise ValueError(f"it holds a {made.name if isinstance(made, Made) else type(made).__name__} for an array")
    return _KNOWN[made.name](made)


@dataclass(eq=False)
class Named:
    """Stand-in for something that a pickle names."""

    name: str

    def __call__(self, *arguments: Any) -> "Made":
        return Made(self.name, arguments)


@dataclass(eq=False)
class Made:
    """Stand-in for the object that a call of the name would make, with the state set afterwards."""

    name: str
    arguments: tuple[Any, ...]
    state: Any = None


class _Reader(pickle._Unpickler):
    """The unpickler written in Python, because only there every step can be replaced."""

    stack: list[Any]
    read: Callable[[int], bytes]
    append: Callable[[Any], None]
    dispatch: ClassVar[dict[int, Callable[..., None]]]

    def __init__(self, file: BinaryIO | io.BytesIO, names: Collection[str]) -> None:
        super().__init__(file, encoding="latin1")
        self._stream = file
        self._names = names

    def find_class(self, module: str, name: str) -> Named:
        full = re.sub(r"^numpy\.core\b", "numpy._core", f"{module}.{name}")
        full = re.sub(r"^scipy\.sparse\._?c(s[rc])\.", r"scipy.sparse.c\1.", full)
        if full not in self._names:
            raise ValueError(f"it asks for {full[:200]}")
        return Named(full)

    def load_newobj(self) -> None:
        arguments = self.stack.pop()
        self.append(self._named(self.stack.pop())(*arguments))

    def load_reduce(self) -> None:
        arguments = self.stack.pop()
        self.append(self._named(self.stack.pop())(*arguments))

    def load_build(self) -> None:
        state, made = self.stack.pop(), self.stack[-1]
        if not isinstance(made, Made):
            raise ValueError(f"it changes a {type(made).__name__}")
        if made.name == _JOBLIB_ARRAY:
            state = dict(state, data=self._following(state))
        made.state = state

    def load_bytearray8(self) -> None:
        """Reads the bytes, where Python's takes as much memory as the pickle says they need."""
        (length,) = struct.unpack("<Q", self.read(8))
        data = self.read(length) if length <= sys.maxsize else b""
        if len(data) < length:
            raise ValueError(f"{length} bytes are cut short")
        self.append(bytearray(data))

    def _named(self, value: Any) -> Named:
        if not isinstance(value, Named):
            raise ValueError(f"it calls a {type(value).__name__}")
        return value

    def _following(self, state: dict[str, Any]) -> bytes:
        """The bytes of an array, which joblib writes after its description, padded at the front."""
        if state.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        return self._stream.read(math.prod(state["shape"]) * _worked_out(state["dtype"]).itemsize)

    dispatch = pickle._Unpickler.dispatch | {
        pickle.NEWOBJ[0]: load_newobj, pickle.REDUCE[0]: load_reduce, pickle.BUILD[0]: load_build,
        pickle.BYTEARRAY8[0]: load_bytearray8,
    }  # fmt: skip


class _Counted(dict):
    """The steps of an unpickler, which fail once too many were taken."""

    def __init__(self, steps: dict[int, Callable[..., None]], left: int) -> None:
        super().__init__(steps)
        self._left = left

    def __getitem__(self, step: int) -> Callable[..., None]:
        self._left -= 1
        if self._left < 0:
            raise ValueError("it takes more steps than any file of its kind")
        return super().__getitem__(step)


def _worked_out(value: Any) -> Any:
    if isinstance(value, dict):
        return {_worked_out(key): _worked_out(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_worked_out(entry) for entry in value)
    if isinstance(value, Made):
        return _KNOWN[value.name](value)
    if isinstance(value, Named):
        raise ValueError(f"it holds {value.name} itself")
    return value


def _array(made: Made) -> np.ndarray:
    _, shape, dtype, fortran, data = made.state
    return _numbers(data, dtype).reshape(shape, order="F" if fortran else "C")


def _array_from_buffer(made: Made) -> np.ndarray:
    data, dtype, shape, order = made.arguments
    return _numbers(data, dtype).reshape(shape, order=order)


def _joblib_array(made: Made) -> np.ndarray:
    state = made.state
    return _numbers(state["data"], state["dtype"]).reshape(state["shape"], order=state["order"])


def _scalar(made: Made) -> np.generic:
    dtype, data = made.arguments
    return _numbers(data, dtype)[0]


def _numbers(data: Any, dtype: Any) -> np.ndarray:
    """A writable copy as an array; Python 2 wrote bytes as text."""
    kind = _worked_out(dtype)
    if isinstance(data, list | tuple | dict):  # a few steps can make lists of lists with no end
        raise ValueError(f"it holds a {type(data).__name__} for the bytes of an array")
    data = _worked_out(data)
    return np.frombuffer(bytearray(data.encode("latin1") if isinstance(data, str) else data), kind)


def _dtype(made: Made) -> np.dtype:
    """Allows only dtypes of numbers, because the bytes of objects would be read as addresses."""
    name = made.arguments[0] if isinstance(made.arguments[0], str) else type(made.arguments[0]).__name__
    if not re.fullmatch(r"[?]|b1|[iu][1248]|f[248]", name):
        raise ValueError(f"it holds an array of {name[:40]!r}, not of numbers")
    order = "=" if made.state is None else made.state[1]
    return np.dtype(name).newbyteorder("=" if order == "|" else order)  # pyright: ignore[reportArgumentType]


def _encoded(made: Made) -> bytes:
    text, encoding = made.arguments
    if encoding != "latin1":
        raise ValueError(f"it holds bytes in the encoding {encoding!r}")
    return text.encode("latin1")


def _tensor(made: Made) -> np.ndarray:
    storage, offset, size, stride, *_ = made.arguments
    if not isinstance(storage, Made) or storage.name != _STORAGE:
        raise ValueError("it holds a tensor without numbers")
    kept = torch.load(io.BytesIO(storage.arguments[0]), map_location="cpu", weights_only=True)
    flat = torch.empty(0, dtype=kept.dtype).set_(kept._untyped_storage)
    return flat.as_strided(tuple(size), tuple(stride), offset).contiguous().numpy()


def _refused(made: Made) -> Any:
    raise ValueError(f"it holds a {made.name}, which is no array")


def _sparse(made: Made) -> np.ndarray:
    state = {key.lstrip("_"): _worked_out(entry) for key, entry in made.state.items()}
    rows, columns = state["shape"]
    by_row = made.name == "scipy.sparse.csr.csr_matrix"
    dense = np.zeros((rows, columns) if by_row else (columns, rows), state["data"].dtype)
    # NumPy checks the indices; scipy would write to them unchecked.
    np.add.at(dense, (np.repeat(np.arange(len(dense)), np.diff(state["indptr"])), state["indices"]), state["data"])
    return dense if by_row else dense.T


def _chumpy(made: Made) -> np.ndarray:
    """A wrapped array, or a selection of another array's entries in its own shape."""
    if "x" in made.state:
        return np.asarray(_worked_out(made.state["x"]))
    whole, taken = (_worked_out(made.state[key]) for key in ("a", "idxs"))
    return whole.ravel()[taken].reshape(_worked_out(made.state["preferred_shape"]))


def _no_bytes(made: Made) -> bytes:
    """The empty bytes, as the oldest protocols write them."""
    return _refused(made) if made.arguments else b""


def _reconstructed(made: Made) -> Any:
    """An object of the oldest protocols, whose class is an argument."""
    kind = made.arguments[0]
    return _worked_out(Made(kind.name, (), made.state)) if isinstance(kind, Named) else _refused(made)


_ARRAYS = ("numpy._core.multiarray._reconstruct", "numpy._core.numeric._frombuffer")
_JOBLIB_ARRAY = "joblib.numpy_pickle.NumpyArrayWrapper"
_STORAGE = "torch.storage._load_from_bytes"

_KNOWN: dict[str, Callable[[Made], Any]] = {
    "numpy._core.multiarray._reconstruct": _array,
    "numpy._core.multiarray.scalar": _scalar,
    "numpy._core.numeric._frombuffer": _array_from_buffer,
    "numpy.dtype": _dtype,
    "numpy.ndarray": _refused,
    "_codecs.encode": _encoded,
    _JOBLIB_ARRAY: _joblib_array,
    "torch._utils._rebuild_tensor_v2": _tensor,
    _STORAGE: _refused,
    "collections.OrderedDict": lambda made: dict(_worked_out(list(made.arguments))),
    "scipy.sparse.csc.csc_matrix": _sparse,
    "scipy.sparse.csr.csr_matrix": _sparse,
    "chumpy.ch.Ch": _chumpy,
    "chumpy.reordering.Select": _chumpy,
    "copy_reg._reconstructor": _reconstructed,
    "copyreg._reconstructor": _reconstructed,
    "__builtin__.object": _refused,
    "builtins.object": _refused,
    "__builtin__.bytes": _no_bytes,
}
"""What a pickle may name, and the function that turns it into a value."""
_OF_NUMPY = tuple(name for name in _KNOWN if name.startswith(("numpy.", "_codecs.")))
