"""What can be wrong with a log of Argoverse 2: one clear error each, and memory stays small."""

import random
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparsestreet.data.argoverse2 import Argoverse2Reader, reader
from sparsestreet.data.argoverse2.reader import read_columns
from sparsestreet.data.problems import LogError
from tests.data.damage import daily
from tests.data.plan import Plan

pytest.importorskip("pyarrow", reason="feather files need pyarrow")

from tests.data.argoverse2.write import read_table, sweep_stamp, write_log, write_table

PLAN = Plan()
POSES, BOXES = "city_SE3_egovehicle.feather", "annotations.feather"
INTRINSICS, MOUNTS = "calibration/intrinsics.feather", "calibration/egovehicle_SE3_sensor.feather"
SWEEP = f"sensors/lidar/{sweep_stamp(PLAN, 1)}.feather"
IMAGE = f"sensors/cameras/ring_front_center/{sweep_stamp(PLAN, 1) + 38_000_000}.jpg"


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    return write_log(tmp_path_factory.mktemp("av2"))


@pytest.fixture
def log(sound, tmp_path) -> Path:
    return shutil.copytree(sound, tmp_path / sound.name)


def cells(file: str, **changes: Any) -> Callable[[Path], None]:
    """Columns anew, or the last cell of one."""

    def change(log: Path) -> None:
        table = read_table(log / file)
        for name, value in changes.items():
            if np.ndim(value):
                table[name] = value
            else:
                table[name][-1] = value
        write_table(log / file, table)

    return change


def columns(file: str, edit: Callable[[dict[str, Any]], Any], **options: Any) -> Callable[[Path], None]:
    def change(log: Path) -> None:
        table = read_table(log / file)
        edit(table)
        write_table(log / file, table, **options)

    return change


def content(file: str, edit: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda log: void((log / file).write_bytes(edit((log / file).read_bytes())))


def remove(file: str) -> Callable[[Path], None]:
    return lambda log: shutil.rmtree(log / file) if (log / file).is_dir() else (log / file).unlink()


def rename(file: str, name: str) -> Callable[[Path], None]:
    return lambda log: void((log / file).rename((log / file).with_name(name)))


def void(value: object) -> None:
    """Takes what a damage returns."""


def rows(table: dict[str, Any], keep: Any) -> None:
    table.update({name: column[keep] for name, column in table.items()})


def two_of_one_name(log: Path) -> None:
    import pyarrow as pa
    from pyarrow import feather as arrow

    table = arrow.read_table(str(log / SWEEP))
    arrow.write_feather(table.append_column("x", pa.array(np.zeros(len(table)))), str(log / SWEEP))


def categories(log: Path) -> None:
    from pyarrow import feather as arrow

    table = arrow.read_table(str(log / BOXES))
    place = table.column_names.index("category")
    coded = table.set_column(place, "category", table["category"].dictionary_encode())
    arrow.write_feather(coded, str(log / BOXES))


def empty_cell(log: Path) -> None:
    import pyarrow as pa

    table = read_table(log / SWEEP)
    write_table(log / SWEEP, table | {"y": pa.array([None, *table["y"][1:].astype(float)])})


DAMAGES: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "no path": (remove(POSES), "", "no log of Argoverse 2"),
    "no intrinsics": (remove(INTRINSICS), INTRINSICS, "missing"),
    "no mounts": (remove(MOUNTS), MOUNTS, "missing"),
    "no sweeps": (remove("sensors/lidar"), "sensors/lidar", "no sweeps"),
    "no images": (remove("sensors/cameras"), "sensors/cameras", "no images"),
    "a folder for a table": (lambda log: remove(INTRINSICS)(log) or (log / INTRINSICS).mkdir(), INTRINSICS, "missing"),
    "empty": (content(SWEEP, lambda data: b""), SWEEP, "no whole feather file"),
    "text": (content(BOXES, lambda data: b"not a table, " * 40), BOXES, "Not an Arrow file"),
    "half": (content(POSES, lambda data: data[: len(data) // 2]), POSES, "Not an Arrow file"),
    "footer beyond": (
        content(SWEEP, lambda data: data[:-10] + struct.pack("<i", 2**30) + data[-6:]),
        SWEEP,
        "no whole feather file",
    ),
    "no column": (columns(SWEEP, lambda table: table.pop("z")), SWEEP, "no column z"),
    "two columns": (two_of_one_name, SWEEP, "two columns of one name"),
    "text for numbers": (
        columns(POSES, lambda table: table.update(qw=["a"] * len(table["qw"]))),
        POSES,
        "column qw holds string, not numbers",
    ),
    "numbers for text": (
        columns(BOXES, lambda table: table.update(category=np.arange(5))),
        BOXES,
        "column category holds int64, not text",
    ),
    "stamps in seconds": (
        columns(POSES, lambda table: table.update(timestamp_ns=table["timestamp_ns"] / 1e9)),
        POSES,
        "column timestamp_ns holds double, not whole numbers",
    ),
    "categories": (categories, BOXES, "column category holds dictionary"),
    "an empty cell": (empty_cell, SWEEP, "column y has 1 empty cells"),
    "no rows": (columns(POSES, lambda table: rows(table, slice(0))), POSES, "no poses"),
    "poses backwards": (columns(POSES, lambda table: rows(table, slice(None, None, -1))), POSES, "must not decrease"),
    "a gap": (
        columns(POSES, lambda table: rows(table, np.r_[0:5, len(table["qw"]) - 3 : len(table["qw"])])),
        POSES,
        "s lie between two poses",
    ),
    "poses end": (columns(POSES, lambda table: rows(table, slice(40))), POSES, "do not cover"),
    "a pose of NaN": (cells(POSES, tx_m=np.nan), POSES, "holds NaN or infinity"),
    "no rotation": (cells(POSES, qw=0, qx=0, qy=0, qz=0), POSES, "has a quaternion of length 0"),
    "a far pose": (
        columns(POSES, lambda table: table.update(tx_m=1e6 * np.arange(len(table["qw"])))),
        POSES,
        "float32 can hold",
    ),
    "a camera's row": (
        columns(INTRINSICS, lambda table: rows(table, slice(1, 2))),
        INTRINSICS,
        "has images but no row",
    ),
    "a mount twice": (
        cells(MOUNTS, sensor_name=["ring_front_left", "ring_front_left", "up_lidar", "down_lidar"]),
        MOUNTS,
        "has 0 rows",
    ),
    "no focal length": (cells(INTRINSICS, fx_px=0), INTRINSICS, "must be positive"),
    "another size": (cells(INTRINSICS, width_px=64), "sensors/cameras/ring_front_left", "the calibration says 64x24"),
    "a box of no size": (cells(BOXES, width_m=0), BOXES, "smallest length, width, height"),
    "a box of NaN": (cells(BOXES, tz_m=np.nan), BOXES, "holds NaN or infinity"),
    "a box twice": (
        cells(BOXES, track_uuid=np.array(["one"] * 5, dtype=object)),
        BOXES,
        "two boxes at",
    ),
    "a name": (rename(SWEEP, "sweep.feather"), "sensors/lidar/sweep.feather", "no stamp in nanoseconds"),
    "a late name": (rename(IMAGE, f"{10**25}.jpg"), f"{10**25}.jpg", "no stamp in nanoseconds"),
    "a stamp with a zero ahead": (
        lambda log: void(shutil.copy(log / SWEEP, (log / SWEEP).with_name(f"0{sweep_stamp(PLAN, 1)}.feather"))),
        "sensors/lidar",
        "no stamp in nanoseconds",
    ),
    "a torn image": (content(IMAGE, lambda data: data[:300]), IMAGE, "cannot be decoded"),
    "a small image": (lambda log: Image.new("RGB", (8, 8)).save(log / IMAGE), IMAGE, "the image is 8x8"),
    "a point of NaN": (cells(SWEEP, x=np.float16(np.nan)), SWEEP, "1 of"),
}


@pytest.mark.parametrize(
    "name", daily(DAMAGES, "half", "text for numbers", "poses backwards", "a pose of NaN", "a box twice")
)
def test_a_damage_is_one_error_that_names_the_file(name, log):
    damage, file, said = DAMAGES[name]
    damage(log)
    if not file:
        with pytest.raises(ValueError, match=said):
            Argoverse2Reader(root=log).check()
        return
    (problem,) = Argoverse2Reader(root=log).check()
    assert said in problem.message
    assert file in str(problem.path)
    assert problem.remedy


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
