"""Reads arrays from pickles of others without running anything in them.

Unpickling normally calls what the file names. Here a name that describes arrays of numbers becomes a stand-in that
calls
nothing; any other name is refused. After reading, the stand-ins are turned into arrays.
"""

import io
import math
import pickle
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np
import torch


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
    with path.open("rb") as file:
        try:
            return _worked_out(_Reader(file, encoding="latin1").load())
        except Exception as error:  # each opcode of a broken pickle fails in its own way
            reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            raise ValueError(
                f"{path} must be a pickle of plain values and arrays of numbers, which it is not ({reason}): "
                "write it again with nothing else in it, and without compression"
            ) from error


@dataclass(eq=False)
class _Named:
    """Stand-in for something that a pickle names."""

    name: str

    def __call__(self, *arguments: Any) -> "_Made":
        return _Made(self.name, arguments)


@dataclass(eq=False)
class _Made:
    """Stand-in for the object that a call of the name would make, with the state set afterwards."""

    name: str
    arguments: tuple[Any, ...]
    state: Any = None


class _Reader(pickle._Unpickler):
    """The unpickler written in Python, because only there every step can be replaced."""

    stack: list[Any]
    append: Callable[[Any], None]
    dispatch: ClassVar[dict[int, Callable[..., None]]]

    def __init__(self, file: BinaryIO, **options: Any) -> None:
        super().__init__(file, **options)
        self._stream = file

    def find_class(self, module: str, name: str) -> _Named:
        full = re.sub(r"^numpy\.core\b", "numpy._core", f"{module}.{name}")
        full = re.sub(r"^scipy\.sparse\._?c(s[rc])\.", r"scipy.sparse.c\1.", full)
        if full not in _KNOWN:
            raise ValueError(f"it asks for {full}")
        return _Named(full)

    def load_newobj(self) -> None:
        arguments = self.stack.pop()
        self.append(self._named(self.stack.pop())(*arguments))

    def load_reduce(self) -> None:
        arguments = self.stack.pop()
        self.append(self._named(self.stack.pop())(*arguments))

    def load_build(self) -> None:
        state, made = self.stack.pop(), self.stack[-1]
        if not isinstance(made, _Made):
            raise ValueError(f"it changes a {type(made).__name__}")
        if made.name == _JOBLIB_ARRAY:
            state = dict(state, data=self._following(state))
        made.state = state

    def _named(self, value: Any) -> _Named:
        if not isinstance(value, _Named):
            raise ValueError(f"it calls a {type(value).__name__}")
        return value

    def _following(self, state: dict[str, Any]) -> bytes:
        """The bytes of an array, which joblib writes after its description, padded at the front."""
        if state.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        return self._stream.read(math.prod(state["shape"]) * _worked_out(state["dtype"]).itemsize)

    dispatch = pickle._Unpickler.dispatch | {
        pickle.NEWOBJ[0]: load_newobj, pickle.REDUCE[0]: load_reduce, pickle.BUILD[0]: load_build,
    }  # fmt: skip


def _worked_out(value: Any) -> Any:
    if isinstance(value, dict):
        return {_worked_out(key): _worked_out(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_worked_out(entry) for entry in value)
    if isinstance(value, _Made):
        return _KNOWN[value.name](value)
    if isinstance(value, _Named):
        raise ValueError(f"it holds {value.name} itself")
    return value


def _array(made: _Made) -> np.ndarray:
    _, shape, dtype, fortran, data = made.state
    return _numbers(data, dtype).reshape(shape, order="F" if fortran else "C")


def _array_from_buffer(made: _Made) -> np.ndarray:
    data, dtype, shape, order = made.arguments
    return _numbers(data, dtype).reshape(shape, order=order)


def _joblib_array(made: _Made) -> np.ndarray:
    state = made.state
    return _numbers(state["data"], state["dtype"]).reshape(state["shape"], order=state["order"])


def _scalar(made: _Made) -> np.generic:
    dtype, data = made.arguments
    return _numbers(data, dtype)[0]


def _numbers(data: Any, dtype: Any) -> np.ndarray:
    """A writable copy as an array; Python 2 wrote bytes as text."""
    kind, data = _worked_out(dtype), _worked_out(data)
    return np.frombuffer(bytearray(data.encode("latin1") if isinstance(data, str) else data), kind)


def _dtype(made: _Made) -> np.dtype:
    """Allows only dtypes of numbers, because the bytes of objects would be read as addresses."""
    name = str(made.arguments[0])
    if not re.fullmatch(r"[?]|b1|[iu][1248]|f[248]", name):
        raise ValueError(f"it holds an array of {name!r}, not of numbers")
    order = "=" if made.state is None else str(made.state[1])
    return np.dtype(name).newbyteorder("=" if order == "|" else order)  # pyright: ignore[reportArgumentType]


def _encoded(made: _Made) -> bytes:
    text, encoding = made.arguments
    if encoding != "latin1":
        raise ValueError(f"it holds bytes in the encoding {encoding!r}")
    return text.encode("latin1")


def _tensor(made: _Made) -> np.ndarray:
    storage, offset, size, stride, *_ = made.arguments
    if not isinstance(storage, _Made) or storage.name != _STORAGE:
        raise ValueError("it holds a tensor without numbers")
    kept = torch.load(io.BytesIO(storage.arguments[0]), map_location="cpu", weights_only=True)
    flat = torch.empty(0, dtype=kept.dtype).set_(kept._untyped_storage)
    return flat.as_strided(tuple(size), tuple(stride), offset).contiguous().numpy()


def _refused(made: _Made) -> Any:
    raise ValueError(f"it holds a {made.name}, which is no array")


def _sparse(made: _Made) -> np.ndarray:
    state = {key.lstrip("_"): _worked_out(entry) for key, entry in made.state.items()}
    rows, columns = state["shape"]
    by_row = made.name == "scipy.sparse.csr.csr_matrix"
    dense = np.zeros((rows, columns) if by_row else (columns, rows), state["data"].dtype)
    # NumPy checks the indices; scipy would write to them unchecked.
    np.add.at(dense, (np.repeat(np.arange(len(dense)), np.diff(state["indptr"])), state["indices"]), state["data"])
    return dense if by_row else dense.T


def _chumpy(made: _Made) -> np.ndarray:
    """A wrapped array, or a selection of another array's entries in its own shape."""
    if "x" in made.state:
        return np.asarray(_worked_out(made.state["x"]))
    whole, taken = (_worked_out(made.state[key]) for key in ("a", "idxs"))
    return whole.ravel()[taken].reshape(_worked_out(made.state["preferred_shape"]))


def _no_bytes(made: _Made) -> bytes:
    """The empty bytes, as the oldest protocols write them."""
    return _refused(made) if made.arguments else b""


def _reconstructed(made: _Made) -> Any:
    """An object of the oldest protocols, whose class is an argument."""
    kind = made.arguments[0]
    return _worked_out(_Made(kind.name, (), made.state)) if isinstance(kind, _Named) else _refused(made)


_JOBLIB_ARRAY = "joblib.numpy_pickle.NumpyArrayWrapper"
_STORAGE = "torch.storage._load_from_bytes"

_KNOWN: dict[str, Callable[[_Made], Any]] = {
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
