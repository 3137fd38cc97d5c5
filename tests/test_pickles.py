"""Arrays come out of foreign pickles, and nothing in them runs."""

import io
import os
import pickle
import re
import sys
import types
from collections import OrderedDict
from pathlib import Path

import joblib
import numpy as np
import pytest
import scipy.sparse
import torch
from torch._utils import _rebuild_tensor_v2

from sparsestreet.pickles import read_pickled

ARRAYS = {
    "double": np.linspace(0, 1, 12).reshape(2, 3, 2),
    "fortran": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
    "big": np.arange(3, dtype=">i4"),
    "bool": np.array([True, False]),
    "none": np.zeros((0, 3)),
}


def assert_same(found, expected) -> None:
    assert found.keys() == expected.keys()
    for key, array in expected.items():
        np.testing.assert_array_equal(found[key], array)
        assert found[key].shape == array.shape


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_of_every_protocol(protocol, tmp_path):
    path = tmp_path / "arrays.pkl"
    path.write_bytes(pickle.dumps({"frames": [ARRAYS, ARRAYS], 3: (np.float32(0.5), "text", None)}, protocol))
    found = read_pickled(path)
    for frame in found["frames"]:
        assert_same(frame, ARRAYS)
    assert found[3] == (0.5, "text", None)


def test_arrays_and_tensors_of_joblib(tmp_path):
    joblib.dump({7: ARRAYS, "after": [1, 2.5]}, tmp_path / "a.pkl")
    found = read_pickled(tmp_path / "a.pkl")
    assert_same(found[7], ARRAYS)
    assert found["after"] == [1, 2.5]
    turned = torch.arange(24.0).view(2, 3, 4).mT[:, 1:]
    joblib.dump({"turned": turned, "flags": torch.tensor([True, False])}, tmp_path / "b.pkl")
    found = read_pickled(tmp_path / "b.pkl")
    assert_same(found, {"turned": turned.numpy(), "flags": np.array([True, False])})


@pytest.fixture
def chumpy():
    """The classes that wrap arrays in SMPL's files; the package itself runs on no Python of today."""
    ch, reordering = types.ModuleType("chumpy.ch"), types.ModuleType("chumpy.reordering")
    vars(ch)["Ch"] = type("Ch", (), {"__module__": "chumpy.ch"})
    vars(reordering)["Select"] = type("Select", (), {"__module__": "chumpy.reordering"})
    modules = {"chumpy": types.ModuleType("chumpy"), "chumpy.ch": ch, "chumpy.reordering": reordering}
    sys.modules.update(modules)
    yield ch.Ch, reordering.Select
    for name in modules:
        del sys.modules[name]


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_wrapped_and_sparse_arrays(protocol, tmp_path, chumpy):
    Ch, Select = chumpy
    whole = np.arange(12.0).reshape(3, 4)
    wrapped, some = Ch(), Select()
    wrapped.__dict__ = {"x": whole, "dterms": ("x",)}
    some.__dict__ = {"a": wrapped, "idxs": np.array([1, 3, 8]), "preferred_shape": (3, 1)}
    sparse = np.array([[0.0, 2.0, 0.0], [1.0, 0.0, 0.0]])
    stored = {
        "ch": wrapped, "select": some, "csc": scipy.sparse.csc_matrix(sparse), "csr": scipy.sparse.csr_matrix(sparse),
    }  # fmt: skip
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(stored, protocol))
    expected = {"ch": whole, "select": np.array([[1.0], [3.0], [8.0]]), "csc": sparse, "csr": sparse}
    assert_same(read_pickled(tmp_path / "body.pkl"), expected)


def test_entries_of_one_place_add_up(tmp_path):
    """As scipy has it: 1 and 4 in the second column of the only row."""
    twice = scipy.sparse.csr_matrix((np.array([1.0, 2.0, 4.0]), np.array([1, 0, 1]), np.array([0, 3])), shape=(1, 3))
    (tmp_path / "body.pkl").write_bytes(pickle.dumps({"csr": twice}, 2))
    assert_same(read_pickled(tmp_path / "body.pkl"), {"csr": np.array([[2.0, 5.0, 0.0]])})


class Hostile:
    """Runs a command when it is unpickled."""

    def __init__(self, call, *arguments):
        self.call, self.arguments = call, arguments

    def __reduce__(self):
        return self.call, self.arguments


def stored_by_torch(value) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def tensor_of(storage: bytes) -> Hostile:
    return Hostile(_rebuild_tensor_v2, Hostile(torch.storage._load_from_bytes, storage), 0, (1,), (1,))


HOSTILE = {
    "system": lambda path: Hostile(os.system, f"touch {path}"),
    "eval": lambda path: {"betas": Hostile(eval, f"open({str(path)!r}, 'w')")},
    "in joblib's wrapper": lambda path: [np.zeros(2), Hostile(Path(path).touch)],
    "torch.load": lambda path: Hostile(torch.load, str(path)),
    "as an ordered dict": lambda path: OrderedDict(a=Hostile(exec, f"open({str(path)!r}, 'w')")),
    "in a tensor": lambda path: Hostile(
        torch.storage._load_from_bytes, pickle.dumps(Hostile(exec, f"open({str(path)!r}, 'w')"))
    ),
    "as the storage of a tensor": lambda path: tensor_of(stored_by_torch(Hostile(Path(path).touch))),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("dump", [joblib.dump, lambda value, path: path.write_bytes(pickle.dumps(value, 2))])
def test_nothing_runs(name, dump, tmp_path):
    trace, path = tmp_path / "it_ran", tmp_path / "hostile.pkl"
    dump(HOSTILE[name](trace), path)
    with pytest.raises(ValueError, match=rf"{re.escape(str(path))} must be a pickle of plain values and arrays"):
        read_pickled(path)
    assert not trace.exists()


@pytest.mark.parametrize(("call", "name"), [(np.fromfile, "numpy.fromfile"), (os.getcwd, f"{os.name}.getcwd")])
def test_what_a_file_asks_for_is_named(call, name, tmp_path):
    """A name of numpy is no better than any other."""
    path = tmp_path / "hostile.pkl"
    path.write_bytes(pickle.dumps(Hostile(call), 2))
    with pytest.raises(ValueError, match=rf"ValueError: it asks for {re.escape(name)}"):
        read_pickled(path)


def test_objects_are_no_numbers(tmp_path):
    """Their bytes would be addresses."""
    path = tmp_path / "objects.pkl"
    path.write_bytes(pickle.dumps(np.array([{}, None])))
    with pytest.raises(ValueError, match="'O8', not of numbers"):
        read_pickled(path)


@pytest.mark.parametrize("content", [b"", b"x\x9c\x03\x00", pickle.dumps(ARRAYS)[:-40]])
def test_what_is_no_pickle_or_cut_short(content, tmp_path):
    path = tmp_path / "broken.pkl"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="must be a pickle"):
        read_pickled(path)


class TypeOf:
    """An array's type by a name that no array of numbers has."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __reduce__(self):
        return np.dtype, (self.name, False, True)


@pytest.mark.parametrize("name", ["f4,O", "f8,f8", "O"])
def test_a_type_of_several_fields_is_no_type_of_numbers(name, tmp_path):
    path = tmp_path / "types.pkl"
    path.write_bytes(pickle.dumps(TypeOf(name), 2))
    with pytest.raises(ValueError, match=rf"it holds an array of '{name}', not of numbers"):
        read_pickled(path)
