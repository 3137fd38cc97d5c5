"""What can be wrong with a log of Argoverse 2: one clear error each, and memory stays small."""

import random
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparsestreet.data.argoverse2 import Argoverse2Reader, reader
from sparsestreet.data.argoverse2.reader import read_columns
from sparsestreet.data.problems import LogError
from tests.data.damage import Damage, assert_found, cut, daily, gone
from tests.data.plan import Plan

pytest.importorskip("pyarrow", reason="feather files need pyarrow")

from tests.data.argoverse2.write import read_table, sweep_stamp, write_log, write_table

PLAN = Plan()
POSES, BOXES = "city_SE3_egovehicle.feather", "annotations.feather"
INTRINSICS, MOUNTS = "calibration/intrinsics.feather", "calibration/egovehicle_SE3_sensor.feather"
SWEEP = f"sensors/lidar/{sweep_stamp(PLAN, 1)}.feather"


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    return write_log(tmp_path_factory.mktemp("av2"))


@pytest.fixture
def log(sound, tmp_path) -> Path:
    return shutil.copytree(sound, tmp_path / sound.name)


def cells(**changes: Any) -> Damage:
    """Columns anew, or the last cell of one."""

    def change(path: Path) -> None:
        table = read_table(path)
        for name, value in changes.items():
            if np.ndim(value):
                table[name] = value
            else:
                table[name][-1] = value
        write_table(path, table)

    return change


def columns(edit: Callable[[dict[str, Any]], Any]) -> Damage:
    def change(path: Path) -> None:
        table = read_table(path)
        edit(table)
        write_table(path, table)

    return change


def rows(keep: Callable[[int], Any]) -> Damage:
    """Those rows of a table, of how many it has."""
    return columns(lambda table: table.update({name: column[keep(len(column))] for name, column in table.items()}))


def two_of_one_name(path: Path) -> None:
    import pyarrow as pa
    from pyarrow import feather as arrow

    table = arrow.read_table(str(path))
    arrow.write_feather(table.append_column("x", pa.array(np.zeros(len(table)))), str(path))


def categories(path: Path) -> None:
    from pyarrow import feather as arrow

    table = arrow.read_table(str(path))
    place = table.column_names.index("category")
    arrow.write_feather(table.set_column(place, "category", table["category"].dictionary_encode()), str(path))


def empty_cell(path: Path) -> None:
    import pyarrow as pa

    table = read_table(path)
    write_table(path, table | {"y": pa.array([None, *table["y"][1:].astype(float)])})


DAMAGES: dict[str, tuple[str, Damage, str]] = {
    "no mounts": (MOUNTS, gone, "missing"),
    "no sweeps": ("sensors/lidar", gone, "no sweeps"),
    "no images": ("sensors/cameras", gone, "no images"),
    "half": (POSES, cut, "Not an Arrow file"),
    "no column": (SWEEP, columns(lambda table: table.pop("z")), "no column z"),
    "two columns": (SWEEP, two_of_one_name, "two columns of one name"),
    "text for numbers": (
        POSES,
        columns(lambda table: table.update(qw=["a"] * len(table["qw"]))),
        "column qw holds string, not numbers",
    ),
    "stamps in seconds": (
        POSES,
        columns(lambda table: table.update(timestamp_ns=table["timestamp_ns"] / 1e9)),
        "column timestamp_ns holds double, not whole numbers",
    ),
    "categories": (BOXES, categories, "column category holds dictionary"),
    "an empty cell": (SWEEP, empty_cell, "column y has 1 empty cells"),
    "no rows": (POSES, rows(lambda count: slice(0)), "no poses"),
    "poses backwards": (POSES, rows(lambda count: slice(None, None, -1)), "must not decrease"),
    "a gap": (POSES, rows(lambda count: np.r_[0:5, count - 3 : count]), "s lie between two poses"),
    "poses end": (POSES, rows(lambda count: slice(40)), "do not cover"),
    "a pose of NaN": (POSES, cells(tx_m=np.nan), "holds NaN or infinity"),
    "a far pose": (
        POSES,
        columns(lambda table: table.update(tx_m=1e6 * np.arange(len(table["qw"])))),
        "float32 can hold",
    ),
    "a camera's row": (INTRINSICS, rows(lambda count: slice(1, 2)), "has images but no row"),
    "a mount twice": (
        MOUNTS,
        cells(sensor_name=["ring_front_left", "ring_front_left", "up_lidar", "down_lidar"]),
        "has 0 rows",
    ),
    "no focal length": (INTRINSICS, cells(fx_px=0), "must be positive"),
    "a box twice": (BOXES, cells(track_uuid=np.array(["one"] * 5, dtype=object)), "two boxes at"),
    "a point of NaN": (SWEEP, cells(x=np.float16(np.nan)), "1 of"),
}


@pytest.mark.parametrize(
    "name", daily(DAMAGES, "half", "text for numbers", "poses backwards", "a pose of NaN", "a box twice")
)
def test_a_damage_is_one_error_that_names_the_file(name, log):
    file, damage, said = DAMAGES[name]
    damage(log / file)
    assert_found(Argoverse2Reader(root=log), log / file, said)


@pytest.mark.parametrize("name", ["sweep.feather", f"0{10**18}.feather", f"{10**25}.feather"])
def test_a_sweep_whose_name_is_no_stamp(name, log):
    (log / SWEEP).rename((log / SWEEP).with_name(name))
    assert_found(Argoverse2Reader(root=log), (log / SWEEP).with_name(name), "no stamp in nanoseconds")


def test_images_of_another_size_than_the_calibration(log):
    cells(width_px=64)(log / INTRINSICS)
    (problem,) = Argoverse2Reader(root=log).check()
    assert "the calibration says 64x24" in problem.message


def test_a_file_larger_than_any_of_the_data_set_is_refused(log, monkeypatch):
    monkeypatch.setattr(reader, "MAX_BYTES", (log / SWEEP).stat().st_size - 1)
    with pytest.raises(LogError, match=r"that are read"):
        read_columns(log / SWEEP, dict.fromkeys("xyz", float))


def test_text_that_lies_outside_of_its_buffer_is_refused(tmp_path):
    path = tmp_path / "t.feather"
    write_table(path, {"name": ["abc", "def"]}, compression="uncompressed")
    assert read_columns(path, {"name": str})["name"].tolist() == ["abc", "def"]
    data = path.read_bytes()
    ends = struct.pack("<3i", 0, 3, 6)
    assert data.count(ends) == 1
    path.write_bytes(data.replace(ends, struct.pack("<3i", 0, 3, 2**30)))
    with pytest.raises(LogError, match="no whole feather file"):
        read_columns(path, {"name": str})


@pytest.mark.slow
def test_thrown_bytes_are_an_error_or_a_table(sound, tmp_path):
    """300 files with some bytes thrown: nothing else is raised, and what is read has rows of one number."""
    data, dice = (sound / POSES).read_bytes(), random.Random(0)
    path, read = tmp_path / "thrown.feather", 0
    for _ in range(300):
        thrown = bytearray(data)
        start = dice.choice((0, len(data) - 1500))
        for _ in range(dice.randint(1, 8)):
            thrown[min(len(data) - 1, start + dice.randrange(2000))] = dice.randrange(256)
        path.write_bytes(thrown)
        try:
            table = read_columns(path, {"timestamp_ns": int, "qw": float})
        except LogError:
            continue
        read += 1
        assert len(table["timestamp_ns"]) == len(table["qw"])
    assert 10 < read < 290
