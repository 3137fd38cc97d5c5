"""Every damage of a table of version 2 is one clear error that names the file and what is wrong in it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparsestreet.data.problems import LogError
from sparsestreet.data.waymo import WaymoReader
from sparsestreet.data.waymo import v2 as components_of
from sparsestreet.data.waymo.v2 import Table, data_of
from tests.conftest import unchecked
from tests.data.waymo import tables
from tests.data.waymo.drive import Drive
from tests.data.waymo.records import NAME
from tests.data.waymo.tables import CAMERA, FRAME, LASER, SEGMENT, Row, rows_of

pyarrow = pytest.importorskip("pyarrow", reason="version 2 needs pyarrow: pip install 'sparsestreet[parquet]'")

FRAMES = 2
NAN = float("nan")


@pytest.fixture(scope="module")
def components() -> dict[str, tuple[str, list[Row]]]:
    return rows_of(Drive(num_frames=FRAMES))


def write(root: Path, components: dict[str, tuple[str, list[Row]]], component: str, rows: list[Row]) -> Path:
    """All components, one of them with other rows; the path of that one."""
    for name, (prefix, sound) in components.items():
        wanted = rows if name == component else sound
        if wanted:
            tables.write(root / name / f"{NAME}.parquet", prefix, wanted, group=3)
    return root / component / f"{NAME}.parquet"


def cell(column: str, value: Any, row: int = -1) -> Callable[[list[Row]], list[Row]]:
    """Another value in a cell of the last row, or of another one."""

    def change(rows: list[Row]) -> list[Row]:
        place = row % len(rows)
        return [one | {column: value} if number == place else one for number, one in enumerate(rows)]

    return change


def column(name: str, value: Callable[[Any], Any]) -> Callable[[list[Row]], list[Row]]:
    return lambda rows: [row | {name: value(row[name])} for row in rows]


def without(name: str) -> Callable[[list[Row]], list[Row]]:
    return lambda rows: [{key: value for key, value in row.items() if key != name} for row in rows]


POSE, MOUNT, IMAGE = "world_from_vehicle.transform", "extrinsic.transform", "image"
VALUES, SHAPE = "range_image_return1.values", "range_image_return1.shape"
TRIGGER, DONE = (f"rolling_shutter_params.camera_{name}_time" for name in ("trigger", "readout_done"))
TORN = b"\x89PNG\r\n\x1a\nxx"
CELLS = {
    "no pose": ("vehicle_pose", cell(POSE, None), f"a row has no numbers as {POSE}"),
    "far pose": ("camera_image", cell("pose.transform", (np.eye(4) + 1e6 * np.eye(4, k=3)).ravel()), "poses span"),
    "no stamp": ("vehicle_pose", cell(FRAME, None), "does not hold a time a frame"),
    "another segment": ("vehicle_pose", cell(SEGMENT, "other"), "has frames of ['other']"),
    "no column": ("vehicle_pose", without(POSE), f"the columns ['[VehiclePoseComponent].{POSE}'] are missing"),
    "no intrinsic": ("camera_calibration", cell("intrinsic.f_u", None), "a row has None as intrinsic.f_u"),
    "a ninth camera": ("camera_calibration", cell(CAMERA, 9), "a row is of 9, which is not one of"),
    "a camera named ROOF": (
        "camera_calibration",
        column(CAMERA, lambda number: {1: "FRONT"}.get(number, "ROOF")),
        "a row is of 'ROOF'",
    ),
    "uncalibrated lidar": ("lidar_calibration", cell(LASER, 5), "lidar FRONT has range images, but no calibration"),
    "no trigger": ("camera_image", cell(TRIGGER, None), f"a row has None as {TRIGGER}"),
    "no image": ("camera_image", cell(IMAGE, None), "the image of FRONT_LEFT at frame 1 cannot be decoded"),
    "images as text": ("camera_image", column(IMAGE, lambda _: "text"), "holds no bytes"),
    "two boxes of one object": (
        "lidar_box",
        lambda rows: [*rows, rows[-1]],
        "frame 1 has two boxes of the object car-1",
    ),
    "heading as text": ("lidar_box", column("box.heading", str), "as box.heading, not a number"),
    "seen by nobody": ("lidar_camera_synced_box", cell("most_visible_camera_name", 77), "a row is of 77"),
    "too few numbers": ("lidar", cell(VALUES, np.ones(8, np.float32)), "a range image has 8 numbers for the shape"),
    "three channels": ("lidar", cell(SHAPE, [4, 16, 3]), "for the shape [4, 16, 3]"),
    "absurd shape": ("lidar", cell(SHAPE, [2**31 - 1, 2**31 - 1, 4]), "a range image has 256 numbers for the shape"),
    "negative shape": ("lidar", cell(SHAPE, [-4, -16, 4]), "for the shape [-4, -16, 4]"),
    "poses of other pixels": (
        "lidar_pose",
        lambda rows: cell(VALUES, np.ones(54))(cell(SHAPE, [1, 9, 6])(rows)),
        "poses of (1, 9)",
    ),
    "poses of one frame are missing": ("lidar_pose", lambda rows: rows[:-1], "there are no poses of lidar TOP"),
    "torn label": ("camera_segmentation", cell("panoptic_label", TORN), "panoptic label of FRONT at frame 1 cannot"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CELLS)
def test_a_damaged_cell(name, components, tmp_path):
    component, change, said = CELLS[name]
    path = write(tmp_path, components, component, change(components[component][1]))
    problems = WaymoReader(root=tmp_path).check()
    assert len(problems) == 1
    assert said in problems[0].message
    assert problems[0].remedy
    # A lidar without calibration is told where its range images are.
    assert problems[0].path.name == path.name
    assert problems[0].path.parent.name == (
        "lidar"
        if component in ("lidar_calibration", "lidar_pose")
        and ("inclinations" in said or "no calibration" in said or "poses of (" in said)
        else component
    )


FILES = {
    "empty": ("vehicle_pose", lambda content: b""),
    "cut": ("camera_image", lambda content: content[: len(content) // 2]),
    "text": ("lidar_box", lambda content: b"version https://git-lfs.github.com/spec/v1"),
    "broken footer": ("lidar", lambda content: content[:-40] + b"\xff" * 32 + content[-8:]),
    "absurd footer": ("camera_image", lambda content: content[:-8] + b"\xff\xff\xff\x7f" + content[-4:]),
}


@pytest.mark.parametrize("name", FILES)
def test_a_damaged_file(name, components, tmp_path):
    component, change = FILES[name]
    path = write(tmp_path, components, component, components[component][1])
    path.write_bytes(change(path.read_bytes()))
    (problem,) = WaymoReader(root=tmp_path).check()
    assert problem.path == path
    assert "the table cannot be read" in problem.message


@pytest.mark.parametrize("component", ["vehicle_pose", "camera_calibration", "camera_image", "lidar_pose"])
def test_a_missing_component_is_named(component, components, tmp_path):
    write(tmp_path, components, component, components[component][1]).unlink()
    problems = WaymoReader(root=tmp_path).check()
    assert {problem.message for problem in problems} == {f"the component {component} of the segment is missing"}


@pytest.mark.parametrize("component", ["lidar", "lidar_box", "lidar_camera_synced_box", "camera_segmentation"])
def test_an_optional_component_may_be_missing(component, components, tmp_path):
    write(tmp_path, components, component, components[component][1]).unlink()
    reader = WaymoReader(root=tmp_path)
    assert reader.check() == []
    said = {
        "lidar": "no lidar: ",
        "lidar_box": "no boxes: ",
        "lidar_camera_synced_box": "2 of 2 boxes are the lidar's",
        "camera_segmentation": "no sky masks: ",
    }
    assert said[component] in " ".join(reader.read().notes)


@pytest.mark.slow
def test_mutated_tables_are_read_or_refused(components, tmp_path):
    """200 tables with a few bytes changed: no other error than LogError."""
    generator, refused = np.random.default_rng(0), 0
    path = write(tmp_path, components, "camera_image", components["camera_image"][1])
    sound = path.read_bytes()
    for _ in range(200):
        content = bytearray(sound)
        for place in generator.integers(0, len(content), generator.integers(1, 6)):
            content[place] = generator.integers(256)
        path.write_bytes(content)
        try:
            with unchecked():
                table = Table(path, "CameraImageComponent")
                for row in table.rows([FRAME, CAMERA], [components_of.POSE, *components_of.VELOCITY]):
                    components_of.matrix(row, components_of.POSE, path)
                read = table.spooled({0: 0, 3: 3}, ["image"], lambda cells: data_of(cells[0], path))
                _ = read(0), read(3)
        except LogError:
            refused += 1
    assert 20 < refused < 200


def test_types_names_and_orders_of_genuine_files(components, tmp_path, roots):
    """float32 poses and cameras by name, as a genuine table has them; rows in any order, in groups of any size."""
    names = {1: "FRONT", 2: "FRONT_LEFT"}

    def change(component: str, rows: list[Row]) -> list[Row]:
        found = [row | {CAMERA: names[row[CAMERA]]} if CAMERA in row else row for row in rows]
        return [found[place] for place in np.random.default_rng(2).permutation(len(found))]

    drive = Drive(labelled=((1, "front"), (2, "left")))
    tables.write_drive(tmp_path, drive, change=change, single=True, group=1000)
    one, other = WaymoReader(root=tmp_path).recording(), WaymoReader(root=roots[2]).recording()
    for shot, same in zip(one.shots, other.shots, strict=True):
        # float32 at 4 km: 0.24 mm an axis.
        np.testing.assert_allclose(shot.world_from_camera, same.world_from_camera, atol=5e-4)
        assert np.array_equal(one.read_image(shot), other.read_image(same))
        assert bool(one.read_masks(shot)) == ((shot.frame, shot.camera) in ((1, 0), (2, 1)))
    for frame in (2, 0, 3):
        np.testing.assert_allclose(one.sweeps[frame].read(), other.sweeps[frame].read(), atol=1e-3)


@pytest.mark.parametrize("bomb", ["equal rows", "long texts", "long lists"])
def test_rows_that_few_bytes_code_are_counted_as_memory_holds_them(bomb, tmp_path, monkeypatch):
    """Dictionaries and runs code any number of equal cells in some bytes; a tenth of the limit shows it as well."""
    from pyarrow import parquet

    monkeypatch.setattr("sparsestreet.data.waymo.v2._MAX_TABLE", 25_600_000)
    count, size = {"equal rows": (2_000_000, 40), "long texts": (30_000, 10_000), "long lists": (3, 40)}[bomb]
    cells = pyarrow.DictionaryArray.from_arrays(np.zeros(count, np.int8), ["a" * size])
    if bomb == "long lists":
        flat = pyarrow.DictionaryArray.from_arrays(np.zeros(3_000_000, np.int8), ["a" * size])
        cells = pyarrow.ListArray.from_arrays([0, 1_000_000, 2_000_000, 3_000_000], flat.cast(pyarrow.string()))
    path = tmp_path / "bomb.parquet"
    parquet.write_table(pyarrow.table({SEGMENT: cells}), path, store_schema=False)
    assert path.stat().st_size < 100_000
    pool, default = pyarrow.proxy_memory_pool(pyarrow.default_memory_pool()), pyarrow.default_memory_pool()
    pyarrow.set_memory_pool(pool)
    try:
        with pytest.raises(LogError, match=r"the columns key\.segment_context_name \.\.\. take \d+ bytes"):
            Table(path, "CameraImageComponent").rows([SEGMENT], [])
    finally:
        pyarrow.set_memory_pool(default)
    assert pool.max_memory() < 80_000_000  # a step of the limit, and its copies
