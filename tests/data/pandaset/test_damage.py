"""What can be wrong with a sequence of PandaSet: one clear error each; and pickles that would do harm do none."""

import gzip
import json
import os
import pickle
import random
import shutil
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparsestreet.data.pandaset import PandaSetReader, frames
from sparsestreet.data.pandaset.frames import read_columns
from sparsestreet.data.problems import LogError
from tests.conftest import unchecked
from tests.data.damage import Damage, assert_found, cut, daily, gone, written
from tests.data.pandaset.pickles import Call, Global, pickled, table, write
from tests.data.pandaset.write import PandaPlan, cuboids, sweep, write_sequence

PLAN = PandaPlan()
CAMERA = "camera/front_camera"
POSES, STAMPS, LENS = (f"{CAMERA}/{name}.json" for name in ("poses", "timestamps", "intrinsics"))
SWEEP, BOXES, IMAGE = "lidar/01.pkl.gz", "annotations/cuboids/01.pkl.gz", f"{CAMERA}/01.jpg"


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("pandaset"))


@pytest.fixture
def sequence(sound, tmp_path) -> Path:
    return shutil.copytree(sound, tmp_path / sound.name)


def entry(edit: Callable[[Any], Any]) -> Damage:
    def change(path: Path) -> None:
        content = json.loads(path.read_text())
        edit(content)
        path.write_text(json.dumps(content))

    return change


def columns(path: Path) -> dict[str, Any]:
    return (sweep if path.parent.name == "lidar" else cuboids)(PLAN, 1)


def anew(**changes: Any) -> Damage:
    """The table of a file with other columns; None takes one out."""
    return lambda path: write(path, table({k: v for k, v in (columns(path) | changes).items() if v is not None}))


def cell(name: str, value: Any) -> Damage:
    def change(path: Path) -> None:
        found = columns(path)
        found[name][1] = value
        write(path, table(found))

    return change


def half_a_pickle(path: Path) -> None:
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes())[:3000]))


def truncated_block(path: Path) -> None:
    made = table(sweep(PLAN, 1))
    blocks = made.state["_data"].state[3]["0.14.1"]["blocks"]
    (several,) = (block for block in blocks if len(block["values"]) > 1)
    several["values"] = several["values"][:1]
    write(path, made)


DAMAGES: dict[str, tuple[str, Damage, str]] = {
    "no stamps": (STAMPS, gone, "missing"),
    "no image": (IMAGE, gone, "missing"),
    "no sweep": (SWEEP, gone, "missing"),
    "no cuboids": (BOXES, gone, "missing"),
    "lists with no end": (LENS, written(b"[" * 100_000), "no JSON (RecursionError"),
    "text for a number": (POSES, entry(lambda poses: poses[1]["heading"].update(w="up")), "no list of position"),
    "a pose of infinity": (POSES, entry(lambda poses: poses[1]["position"].update(x=1e999)), "NaN or infinity"),
    "a far pose": (POSES, entry(lambda poses: poses[2]["position"].update(x=1e6)), "float32 can hold"),
    "a pose too few": (POSES, entry(lambda poses: poses.pop()), "it has 3 entries, the front camera has 4"),
    "stamps that fall": (STAMPS, entry(lambda stamps: stamps.reverse()), "stamps must increase"),
    "no stamp": (STAMPS, entry(lambda stamps: stamps.append(None)), "stamp 4 is no number of seconds"),
    "a late stamp": (STAMPS, written(b"[1e999999999]"), "stamp 0 is no number of seconds"),
    "no list of stamps": (STAMPS, written(b"{}"), "no list of seconds"),
    "no focal length": (LENS, entry(lambda lens: lens.update(fx=0)), "positive pixels"),
    "a list of a lens": (LENS, written(b"[1, 2, 3, 4]"), "positive pixels"),
    "half a gzip": (SWEEP, cut, "cannot be decompressed"),
    "half a pickle": (SWEEP, half_a_pickle, "no pickled table of plain columns"),
    "no table": (SWEEP, lambda path: write(path, {"x": [1.0]}), "it holds a dict, not a DataFrame"),
    "no column": (SWEEP, anew(t=None), "it has no column t, but x, y, z, i, d"),
    "text for numbers": (BOXES, anew(yaw=["a", "b", "c"]), "column yaw holds a str"),
    "numbers for flags": (BOXES, anew(stationary=np.zeros(3)), "column stationary holds float64"),
    "a block of one column": (SWEEP, truncated_block, "IndexError"),
    "a point of NaN": (SWEEP, cell("x", np.nan), "1 of"),
    "a box twice": (BOXES, anew(uuid=["a", "a", "b"], **{"cuboids.sibling_id": [""] * 3}), "has two boxes"),
}


@pytest.mark.parametrize(
    "name", daily(DAMAGES, "half a pickle", "no column", "stamps that fall", "a pose of infinity", "a box twice")
)
def test_a_damage_is_one_error_that_names_the_file(name, sequence):
    file, damage, said = DAMAGES[name]
    damage(sequence / file)
    assert_found(PandaSetReader(root=sequence), sequence / file, said)


@pytest.mark.parametrize("place", [10**9, -(10**9), 3])
@pytest.mark.parametrize("era", ["old", "new"])
def test_a_table_whose_blocks_are_elsewhere_is_refused_before_pandas_writes_there(era, place, tmp_path):
    made, places = table(sweep(PLAN, 1), era), np.array([0, 1, 2, 3, place])
    if era == "old":
        made.state["_data"].state[3]["0.14.1"]["blocks"][0]["mgr_locs"] = places
    else:
        blocks, axes = made.state["_mgr"].arguments
        moved = replace(blocks[0], arguments=(blocks[0].arguments[0], places, 2))
        made.state["_mgr"] = replace(made.state["_mgr"], arguments=((moved, *blocks[1:]), axes))
    write(tmp_path / "01.pkl", made)
    with pytest.raises(LogError, match="its blocks do not say which columns they hold"):
        read_columns(tmp_path / "01.pkl", {"x": float})


HARM = {
    "os.system": Call(Global("os", "system"), ("touch ran",)),
    "builtins.eval": Call(Global("builtins", "eval"), ("open('ran', 'w')",)),
    "subprocess.Popen": Call(Global("subprocess", "Popen"), (["touch", "ran"],)),
    "pandas.io.pickle.read_pickle": Call(Global("pandas.io.pickle", "read_pickle"), ("/etc/passwd",)),
    "torch.storage._load_from_bytes": Call(Global("torch.storage", "_load_from_bytes"), (b"",)),
    "numpy.lib._datasource.open": Call(Global("numpy.lib._datasource", "open"), ("ran", "w")),
}


@pytest.mark.parametrize("name", HARM)
def test_a_pickle_that_would_do_harm_is_refused_by_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for place in (HARM[name], table({"x": [HARM[name], 1.0]})):
        write(tmp_path / "00.pkl.gz", place)
        with pytest.raises(LogError, match=f"it asks for {name}"):
            read_columns(tmp_path / "00.pkl.gz", {"x": float})
    assert os.listdir(tmp_path) == ["00.pkl.gz"]


def _doubled(depth: int) -> bytes:
    """A list of the list before, twice, ``depth`` times: 2^depth entries in 6 bytes each."""
    steps = b"]" + b"".join(b"q" + bytes([n]) + b"]h" + bytes([n]) + b"ah" + bytes([n]) + b"a" for n in range(depth))
    return b"\x80\x02" + steps + b"."


def _bytearray(length: int) -> bytes:
    return b"\x80\x05\x96" + length.to_bytes(8, "little") + b"."


BOMBS: dict[str, tuple[bytes, str]] = {
    "a list of lists": (_doubled(60), "it holds a list, not a DataFrame"),
    "bytes that are not there": (_bytearray(10**13), "no pickled table"),
    "text that is not there": (b"\x80\x04\x8d" + (2**62).to_bytes(8, "little") + b".", "no pickled table"),
    "a number of a million digits": (b"I" + b"9" * 1_000_000 + b"\n.", "no pickled table"),
    "a frame that is not there": (b"\x80\x04\x95" + (2**62).to_bytes(8, "little") + b".", "no pickled table"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_what_would_take_time_or_memory_is_refused_first(name, tmp_path):
    data, said = BOMBS[name]
    path = tmp_path / "00.pkl.gz"
    path.write_bytes(gzip.compress(data, 1))
    assert path.stat().st_size < 100_000
    started = time.process_time()
    with pytest.raises(LogError, match=said):
        read_columns(path, {"x": float})
    assert time.process_time() - started < 2


def test_lists_with_no_end_are_not_walked_through_where_a_table_has_them(tmp_path):
    """As names of columns, as cells, as shapes, as bytes and as a type of an array."""
    endless: list[Any] = [1]
    for _ in range(60):
        endless = [endless, endless]
    reconstruct, dtype = Global("numpy.core.multiarray", "_reconstruct"), Global("numpy", "dtype")
    start = (Global("numpy", "ndarray"), (0,), b"b")
    double = Call(dtype, ("f8", False, True))
    arrays = {
        "shape": Call(reconstruct, start, (1, endless, double, False, b"")),
        "bytes": Call(reconstruct, start, (1, (1, 1), double, False, endless)),
        "kind": Call(reconstruct, start, (1, (1, 1), Call(dtype, (endless, False, True)), False, b"12345678")),
        "cells": Call(reconstruct, start, (1, (1, 1), Call(dtype, ("O8", False, True)), False, [endless])),
        "object shape": Call(reconstruct, start, (1, endless, Call(dtype, ("O8", False, True)), False, [1.0])),
    }
    for array in (*arrays.values(), endless):
        made = table({"x": np.zeros(1)})
        made.state["_data"].state[3]["0.14.1"]["blocks"][0]["values"] = array
        write(tmp_path / "00.pkl", made)
        with pytest.raises(LogError, match="no pickled table of plain columns"):
            read_columns(tmp_path / "00.pkl", {"x": float})
    made = table({"x": np.zeros(1)})
    made.state["_data"].state[3]["0.14.1"]["axes"][0] = endless
    write(tmp_path / "00.pkl", made)
    with pytest.raises(LogError, match="it holds a "):
        read_columns(tmp_path / "00.pkl", {"x": float})


def test_a_gzip_bomb_is_unpacked_no_further_than_a_sweep(tmp_path, monkeypatch):
    monkeypatch.setattr(frames, "MAX_BYTES", 2_000_000)
    path = tmp_path / "00.pkl.gz"
    path.write_bytes(gzip.compress(b"\0" * 50_000_000, 9))
    assert path.stat().st_size < 60_000
    tracemalloc.start()
    with pytest.raises(LogError, match="takes more than 2 MB"):
        read_columns(path, {"x": float})
    assert tracemalloc.get_traced_memory()[1] < 8_000_000
    tracemalloc.stop()


@pytest.mark.slow
def test_thrown_bytes_are_an_error_or_a_table(tmp_path):
    """300 pickles with some bytes thrown: nothing else is raised, and what is read has rows of one number."""
    columns = {name: values[:5] for name, values in sweep(PLAN, 0).items()} | {"uuid": ["a", "b", "c", None, "e"]}
    sound = [pickled(table(columns, era), protocol) for era in ("old", "new") for protocol in range(2, 6)]
    dice, read = random.Random(0), 0
    with unchecked():
        for number in range(300):
            thrown = bytearray(sound[number % len(sound)])
            for _ in range(dice.randint(1, 4)):
                thrown[dice.randrange(len(thrown))] = dice.randrange(256)
            (tmp_path / "00.pkl").write_bytes(thrown)
            try:
                found = read_columns(tmp_path / "00.pkl", {"x": float, "d": int, "uuid": str})
            except LogError:
                continue
            read += 1
            assert len(found["x"]) == len(found["d"]) == len(found["uuid"])
    assert 10 < read < 290


def test_tables_of_every_protocol_and_order(tmp_path):
    """As NumPy writes arrays by row and by column, and numbers of their own among objects."""
    columns = {"x": np.linspace(0, 1, 3), "y": np.array([1.5, 2.5, 3.5]), "n": np.arange(3)}
    mixed = {"uuid": ["a", None, float("nan")], "t": [np.float64(0.5), 1, 2.0], "flag": [True, np.bool_(False), True]}
    kinds = {"x": float, "y": float, "n": int, "uuid": str, "t": float, "flag": bool}
    for era in ("old", "new"):
        for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
            made = table(columns | mixed, era)
            write(tmp_path / "00.pkl", made, protocol)
            found = read_columns(tmp_path / "00.pkl", kinds)
            np.testing.assert_array_equal(found["x"], columns["x"])
            np.testing.assert_array_equal(found["y"], columns["y"])
            assert (found["n"].tolist(), found["uuid"].tolist()) == ([0, 1, 2], ["a", "", ""])
            assert (found["t"].tolist(), found["flag"].tolist()) == ([0.5, 1.0, 2.0], [True, False, True])


@pytest.mark.parametrize("era", ["old", "new"])
def test_pandas_reads_the_tables_of_these_tests_as_we_do(era, tmp_path):
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "01.pkl.gz"
    for columns in (sweep(PLAN, 1), cuboids(PLAN, 1)):
        write(path, table(columns, era))
        theirs = pandas.read_pickle(path)
        kinds = {name: {"f": float, "i": int, "b": bool}.get(theirs[name].dtype.kind, str) for name in columns}
        ours = read_columns(path, kinds)
        assert list(theirs.columns) == list(columns)
        for name, kind in kinds.items():
            expected = theirs[name].fillna("") if kind is str else theirs[name]
            np.testing.assert_array_equal(ours[name], expected.to_numpy())
        if pandas.__version__ < "3":
            theirs.to_pickle(path)
            again = read_columns(path, kinds)
            for name in kinds:
                np.testing.assert_array_equal(again[name], ours[name])


def test_a_list_shorter_than_its_array_is_refused_before_numpy_reads_beyond_it(tmp_path):
    content = pickle.dumps(np.array(["car", "bus"], dtype=object), protocol=2)
    assert content.count(b"K\x02\x85") == 1  # the shape
    (tmp_path / "00.pkl").write_bytes(content.replace(b"K\x02\x85", b"K\x09\x85"))
    with pytest.raises(LogError, match=r"it holds 2 objects for an array of shape \(9,\)"):
        read_columns(tmp_path / "00.pkl", {"x": str})


def test_an_image_of_another_size_is_no_frame(sequence):
    with Image.open(sequence / IMAGE) as image:
        wide, high = image.size
        image.resize((wide // 2, high // 2)).save(sequence / IMAGE)
    reader = PandaSetReader(root=sequence)
    said = f"the image is {wide // 2}x{high // 2}, the first image of the camera is {wide}x{high}"
    with pytest.raises(LogError, match=said):
        list(reader.read().frames)
    assert [(problem.path.name, problem.message) for problem in reader.check_contents()] == [("01.jpg", said)]
