"""Tables as pandas pickles them, written without pandas: as version 1.0 did, and as versions 1.3 to 2 do."""

import gzip
import io
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

Era = Literal["old", "new"]


@dataclass(frozen=True)
class Global:
    """A name that the pickle asks for."""

    module: str
    name: str


@dataclass(frozen=True)
class Call:
    """A call of a name, or of its ``__new__``, and the state that is set afterwards."""

    function: Global
    arguments: tuple[Any, ...]
    state: Any = None
    new: bool = False


class _Pickler(pickle._Pickler):
    write: Callable[[bytes], object]

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if isinstance(obj, Global):
            self.write(pickle.GLOBAL + f"{obj.module}\n{obj.name}\n".encode())
        elif isinstance(obj, Call):
            self.save(obj.function)
            self.save(obj.arguments)
            self.write(pickle.NEWOBJ if obj.new else pickle.REDUCE)
            if obj.state is not None:
                self.save(obj.state)
                self.write(pickle.BUILD)
        else:
            super().save(obj, save_persistent_id)  # pyright: ignore[reportAttributeAccessIssue]


def pickled(value: Any, protocol: int = 4) -> bytes:
    stream = io.BytesIO()
    _Pickler(stream, protocol).dump(value)
    return stream.getvalue()


def table(columns: Mapping[str, Any], era: Era = "old") -> Call:
    """A DataFrame with a block for each type of columns. Text and mixed columns are lists or arrays of objects."""
    arrays = {name: _column(values) for name, values in columns.items()}
    count = len(next(iter(arrays.values())))
    kinds = {array.dtype for array in arrays.values()}
    places = {kind: np.array([i for i, a in enumerate(arrays.values()) if a.dtype == kind]) for kind in kinds}
    blocks = [(np.stack([list(arrays.values())[i] for i in place]), place) for place in places.values()]
    axes = [_index(list(arrays)), _rows(count)]
    return Call(Global("pandas.core.frame", "DataFrame"), (), _state(blocks, axes, era), new=True)


def write(path: Path, value: Any, protocol: int = 4) -> None:
    """Compressed where the name ends with .gz."""
    path.parent.mkdir(parents=True, exist_ok=True)
    data = value if isinstance(value, bytes) else pickled(value, protocol)
    path.write_bytes(gzip.compress(data, 1) if path.suffix == ".gz" else data)


def _column(values: Any) -> np.ndarray:
    if isinstance(values, np.ndarray):
        return values
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array


def _index(names: list[str]) -> Call:
    data = {"data": _column(names), "name": None}
    return Call(Global("pandas.core.indexes.base", "_new_Index"), (Global("pandas.core.indexes.base", "Index"), data))


def _rows(count: int) -> Call:
    data = {"name": None, "start": 0, "stop": count, "step": 1}
    kind = Global("pandas.core.indexes.range", "RangeIndex")
    return Call(Global("pandas.core.indexes.base", "_new_Index"), (kind, data))


def _state(blocks: list[tuple[np.ndarray, np.ndarray]], axes: list[Call], era: Era) -> dict[str, Any]:
    manager = Global("pandas.core.internals.managers", "BlockManager")
    described = {"_typ": "dataframe", "_metadata": [], "attrs": {}}
    if era == "new":
        unpickle = Global("pandas._libs.internals", "_unpickle_block")
        made = tuple(Call(unpickle, (values, _slice(place), 2)) for values, place in blocks)
        return {"_mgr": Call(manager, (made, axes)), "_flags": {"allows_duplicate_labels": True}} | described
    inner = {"axes": axes, "blocks": [{"values": values, "mgr_locs": _slice(place)} for values, place in blocks]}
    state = (axes, [values for values, _ in blocks], [axes[0]] * len(blocks), {"0.14.1": inner})
    return {"_data": Call(manager, (), state, new=True)} | described


def _slice(places: np.ndarray) -> Any:
    """As pandas has them: a slice where the places are evenly spaced, else their array."""
    steps = set(np.diff(places).tolist())
    if len(steps) > 1:
        return places
    step = steps.pop() if steps else 1
    return slice(int(places[0]), int(places[-1]) + step, step)
