"""Reads arrays and tables from pickles of others without running anything in them.

Unpickling calls what the file names. Here a name must be one of a list. What describes types and arrays of NumPy is
replaced by functions that check it, because NumPy would take the bytes of objects for addresses.
"""

import io
import math
import pickle
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
import torch

from sparsestreet.atomic import check_regular

NO_NAMES: Mapping[str, Any] = MappingProxyType({})


def read_pickled(path: Path) -> Any:
    """Read dicts, lists, numbers, text and arrays of numbers from a pickle, or from joblib's without compression.

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
            return _plain(unpickled(file))
        except Exception as error:  # each opcode of a broken pickle fails in its own way
            reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            raise ValueError(
                f"{path} must be a pickle of plain values and arrays of numbers, which it is not ({reason[:300]}): "
                "write it again with nothing else in it, and without compression"
            ) from error


def unpickled(file: BinaryIO | io.BytesIO, names: Mapping[str, Any] = NO_NAMES) -> Any:
    """Return what a pickle holds. Raises ValueError, or whatever a step of a broken pickle fails with.

    Args:
        file: the pickle.
        names: what it may call beside NumPy's, by module and name; given names allow arrays of objects too.

    >>> unpickled(io.BytesIO(pickle.dumps(range(3))), {"builtins.range": range})
    range(0, 3)
    """
    return _Reader(file, names).load()


class _Reader(pickle.Unpickler):
    def __init__(self, file: BinaryIO | io.BytesIO, names: Mapping[str, Any]) -> None:
        # Without ``peek`` nothing is read ahead: joblib's arrays follow in the same file.
        super().__init__(_Exact(file), encoding="latin1")
        own = {"numpy.dtype": _ObjectType if names else _Type, _JOBLIB: type("_Joblib", (_Joblib,), {"file": file})}
        self._names = {**_NUMPY, **(names or _WRAPPED), **own}

    def find_class(self, module: str, name: str) -> Any:
        full = re.sub(r"^numpy\.core\b", "numpy._core", f"{module}.{name}")
        full = re.sub(r"^scipy\.sparse\._?c(s[rc])\.", r"scipy.sparse.c\1.", full)
        if full not in self._names:
            raise ValueError(f"it asks for {full[:200]}")
        return self._names[full]


class _Exact:
    def __init__(self, file: BinaryIO | io.BytesIO) -> None:
        self.read, self.readline = file.read, file.readline


class _Type:
    """A dtype of numbers."""

    names = r"[?]|b1|[iu][1248]|f[248]"

    def __init__(self, name: Any, *_: Any) -> None:
        if not isinstance(name, str) or not re.fullmatch(self.names, name):
            shown = name if isinstance(name, str) else type(name).__name__
            raise ValueError(f"it holds an array of {shown[:40]!r}, not of numbers")
        self.value = np.dtype(name)

    def __setstate__(self, state: Any) -> None:
        """Take the order of bytes alone: fields would turn numbers into objects."""
        self.value = self.value.newbyteorder("=" if state[1] == "|" else state[1])


class _ObjectType(_Type):
    """A dtype of numbers, or of objects that the pickle holds one by one."""

    names = rf"{_Type.names}|O8?"


class _Array(np.ndarray):
    """An array whose type was checked."""

    def __setstate__(self, state: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        version, shape, kind, fortran, data = state
        numbers = _numpy_type(kind)
        # NumPy follows the missing pointers of a list that is shorter than the shape, and the process ends.
        if numbers.hasobject and len(data) != math.prod(shape):
            raise ValueError(f"it holds {len(data)} objects for an array of shape {shape}")
        super().__setstate__((version, shape, numbers, fortran, data))


class _Joblib:
    """The description of an array, whose bytes follow in the file."""

    file: BinaryIO

    def __setstate__(self, state: Any) -> None:
        if state.get("numpy_array_alignment_bytes") is not None:
            self.file.read(self.file.read(1)[0])
        kind = _numpy_type(state["dtype"])
        data = self.file.read(math.prod(state["shape"]) * kind.itemsize)
        self.array = _from_buffer(data, state["dtype"], state["shape"], state["order"])


class _Attributes:
    """An object that only keeps its attributes."""

    def __setstate__(self, state: Any) -> None:
        # Without this method a pickle could set attributes of the class itself.
        vars(self).update(state)


class _Sparse(_Attributes):
    by_row = True

    @property
    def array(self) -> np.ndarray:
        state = {key.lstrip("_"): entry for key, entry in vars(self).items()}
        rows, columns = state["shape"]
        dense = np.zeros((rows, columns) if self.by_row else (columns, rows), state["data"].dtype)
        # NumPy checks the indices; scipy would write to them unchecked.
        np.add.at(dense, (np.repeat(np.arange(len(dense)), np.diff(state["indptr"])), state["indices"]), state["data"])
        return dense if self.by_row else dense.T


class _SparseColumns(_Sparse):
    by_row = False


class _Chumpy(_Attributes):
    """A wrapped array, or a selection of another array's entries in its own shape."""

    @property
    def array(self) -> np.ndarray:
        state = vars(self)
        if "x" in state:
            return np.asarray(_plain(state["x"]))
        return _plain(state["a"]).ravel()[state["idxs"]].reshape(state["preferred_shape"])


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {_plain(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_plain(entry) for entry in value)
    if isinstance(value, np.ndarray):
        return np.asarray(value)
    if isinstance(value, _Joblib | _Sparse | _Chumpy):
        return value.array
    if value is None or isinstance(value, bool | int | float | str | bytes | np.generic):
        return value
    raise ValueError(f"it holds a {getattr(value, '__name__', type(value).__name__)}, which is no array")


def _numpy_type(kind: Any) -> np.dtype:
    if not isinstance(kind, _Type):
        raise ValueError("it holds an array without a type")
    return kind.value


def _new_array(*_: Any) -> np.ndarray:
    return _Array(0, np.uint8)


def _from_buffer(data: Any, kind: Any, shape: Any, order: Any) -> np.ndarray:
    """Return a writable copy; NumPy refuses objects."""
    return np.frombuffer(bytearray(data), _numpy_type(kind)).reshape(shape, order=order)  # pyright: ignore[reportCallIssue, reportArgumentType]


def _scalar(kind: Any, data: Any) -> Any:
    data = data.encode("latin1") if isinstance(data, str) else data
    return np.frombuffer(data, _numpy_type(kind))[0]


def _encoded(text: Any, encoding: Any) -> bytes:
    if encoding != "latin1":
        raise ValueError(f"it holds bytes in the encoding {encoding!r}")
    return text.encode("latin1")


def _storage(data: Any) -> Any:
    return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)


def _tensor(storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> np.ndarray:
    if not isinstance(storage, torch.storage.TypedStorage):
        raise ValueError("it holds a tensor without numbers")
    flat = torch.empty(0, dtype=storage.dtype).set_(storage._untyped_storage)
    return flat.as_strided(tuple(size), tuple(stride), offset).contiguous().numpy()


def _made(kind: Any, *_: Any) -> Any:
    """Return an object of the oldest protocols, whose class is an argument."""
    if not (isinstance(kind, type) and issubclass(kind, _Attributes | _Joblib)):
        raise ValueError("it holds an object of another class")
    return kind()


_JOBLIB = "joblib.numpy_pickle.NumpyArrayWrapper"
_NUMPY: dict[str, Callable[..., Any]] = {
    "numpy._core.multiarray._reconstruct": _new_array,
    "numpy._core.multiarray.scalar": _scalar,
    "numpy._core.numeric._frombuffer": _from_buffer,
    "numpy.ndarray": _Attributes,
    "_codecs.encode": _encoded,
    "__builtin__.bytes": bytes,
}
_WRAPPED: dict[str, Callable[..., Any]] = {
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch.storage._load_from_bytes": _storage,
    "collections.OrderedDict": dict,
    "scipy.sparse.csc.csc_matrix": _SparseColumns,
    "scipy.sparse.csr.csr_matrix": _Sparse,
    "chumpy.ch.Ch": _Chumpy,
    "chumpy.reordering.Select": _Chumpy,
    "copy_reg._reconstructor": _made,
    "copyreg._reconstructor": _made,
    "__builtin__.object": _Attributes,
    "builtins.object": _Attributes,
}
"""What a file of arrays may name beside NumPy's own."""
