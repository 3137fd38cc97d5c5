"""Each damage is one clear error that names the file, and the field where it is one; nothing hangs."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparsestreet.data.nuscenes import NuScenesReader
from sparsestreet.data.problems import LogError
from tests.conftest import unchecked
from tests.data.nuscenes.written import TABLES, Written, write_nuscenes
from tests.data.plan import Plan

Damage = Callable[[Written], object]


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Written:
    return write_nuscenes(tmp_path_factory.mktemp("nuscenes") / "drive", Plan(num_frames=3))


@pytest.fixture
def drive(sound, tmp_path) -> Written:
    shutil.copytree(sound.root, tmp_path / "drive")
    return Written(tmp_path / "drive")


def setting(table: str, place: int, **values: Any) -> Damage:
    return lambda drive: drive.edit(table, lambda rows: rows[place].update(values))


def without(table: str, place: int) -> Damage:
    return lambda drive: drive.edit(table, lambda rows: rows.pop(place))


def twice(table: str, place: int, **values: Any) -> Damage:
    return lambda drive: drive.edit(table, lambda rows: rows.append({**rows[place], **values}))


def text(table: str, content: str) -> Damage:
    return lambda drive: drive.table(table).write_text(content)


def cut(find: Callable[[Written], Path], kept: int) -> Damage:
    """The file's first bytes alone; a negative number counts from its end."""

    def damage(drive: Written) -> None:
        path = find(drive)
        path.write_bytes(path.read_bytes()[:kept])

    return damage


def image(drive: Written) -> Path:
    return drive.file("CAM_FRONT", 1)


def sweep(drive: Written) -> Path:
    return drive.file("LIDAR_TOP", 1)


def broken_point(drive: Written) -> None:
    points = np.fromfile(sweep(drive), "<f4")
    points[0] = np.nan
    points.tofile(sweep(drive))


def huge(drive: Written) -> None:
    with sweep(drive).open("r+b") as file:
        file.truncate(200_000_000)


SCENE, SAMPLE, DATA = "scene", "sample", "sample_data"
EGO, MOUNT, BOX = "ego_pose", "calibrated_sensor", "sample_annotation"
DAMAGES: dict[str, tuple[Damage, str, str]] = {
    "no scenes": (lambda drive: drive.table(SCENE).unlink(), SCENE, "the table is missing"),
    "scenes that are no JSON": (text(SCENE, "[{'name'"), SCENE, "the table cannot be read"),
    "scenes in an object": (text(SCENE, "{}"), SCENE, "must be a JSON list of objects"),
    "scenes without end": (text(SCENE, "[" * 200_000), SCENE, "the table cannot be read"),
    "an empty list of scenes": (text(SCENE, "[]"), SCENE, "the table has no scenes"),
    "a scene without name": (setting(SCENE, 0, name=None), SCENE, "name must be text, got None"),
    "fewer samples than said": (setting(SCENE, 0, nbr_samples=4), SAMPLE, "has 3 samples, scene.json says 4"),
    "another first sample": (setting(SCENE, 0, first_sample_token="a"), SCENE, "must be the ends of its samples"),
    "a sample missing": (without(SAMPLE, 1), SAMPLE, "has 2 samples, scene.json says 3"),
    "samples out of order": (setting(SAMPLE, 1, timestamp=1), SAMPLE, "prev must link to the sample before it"),
    "files cut short": (cut(lambda drive: drive.table(DATA), 3000), DATA, "the table is cut short"),
    "no files": (text(DATA, "[]"), DATA, "scene-0061 has no camera images"),
    "a file missing in the middle": (without(DATA, 1), DATA, "next must be empty or another row"),
    "a file twice": (twice(DATA, 1), DATA, "1 rows of the scene have the token of another row"),
    "a stamp beyond 64 bits": (setting(DATA, 1, timestamp=2**62), DATA, "timestamp must be whole microseconds"),
    "a stamp in nanoseconds, as a float": (
        setting(DATA, 1, timestamp=1.67e18),
        DATA,
        "timestamp must be whole microseconds within 0 and 9223372036854775, got 1.67e+18",
    ),
    "a keyframe far from its sample": (setting(DATA, 1, timestamp=9), DATA, "must be near its sample"),
    "a keyframe by a number": (setting(DATA, 1, is_key_frame=1), DATA, "must be true or false, got 1"),
    "a path out of the folder": (setting(DATA, 1, filename="../a.jpg"), DATA, "below the data set's"),
    "an absolute path": (setting(DATA, 1, filename="/etc/passwd"), DATA, "below the data set's"),
    "a size of nothing": (setting(DATA, 0, width=0), DATA, "width, height must be positive"),
    "a size that grows": (setting(DATA, 1, width=33), DATA, "width, height must be positive, and"),
    "no pose of an image": (without(EGO, 1), EGO, "1 rows that other tables name are missing"),
    "a pose with NaN": (setting(EGO, 1, translation=[0, float("nan"), 0]), EGO, "finite numbers of"),
    "a pose of text": (setting(EGO, 1, translation=["0", "1", "2"]), EGO, "translation must hold"),
    "a rotation of length 2": (setting(EGO, 1, rotation=[2, 0, 0, 0]), EGO, "must be a unit quaternion"),
    "a pose 5,000 km away": (setting(EGO, 1, translation=[5e6, 0, 0]), "", "poses span 4995.9 km"),
    "a camera without lens": (setting(MOUNT, 0, camera_intrinsic=[]), MOUNT, "shape (3, 3)"),
    "a lens turned over": (
        setting(MOUNT, 0, camera_intrinsic=[[-30, 0, 16], [0, 30, 12], [0, 0, 1]]),
        MOUNT,
        "with positive fx and fy",
    ),
    "a lens of ragged rows": (
        setting(MOUNT, 0, camera_intrinsic=[[30, 0, 16], [0, 30], [1]]),
        MOUNT,
        "camera_intrinsic must hold numbers",
    ),
    "a box without width": (setting(BOX, 1, size=[0, 4, 2]), BOX, "a positive width"),
    "two boxes at once": (twice(BOX, 1, token="b"), BOX, "must have one box a sample"),
    "returns as text": (setting(BOX, 1, num_lidar_pts="3"), BOX, "num_lidar_pts must be"),
    "attributes as text": (setting(BOX, 1, attribute_tokens="a"), BOX, "list of tokens"),
    "no category": (text("category", "[]"), "category", "1 rows that other tables name are missing"),
    "an image missing": (lambda drive: image(drive).unlink(), "", "the file is missing"),
    "an image cut short": (cut(image, -100), "", "the image cannot be decoded"),
    "an image of another camera": (
        lambda drive: drive.edit(DATA, lambda rows: [row.update(width=40) for row in rows[:3]]),
        "",
        "the image is 32x24, sample_data.json says 40x24",
    ),
    "a sweep missing": (lambda drive: sweep(drive).unlink(), "", "the file is missing"),
    "a sweep cut short": (cut(sweep, -3), "", "are no whole number of rows of 5 float32"),
    "a sweep of 200 MB": (huge, "", "200000000 bytes are no whole number of rows of 5 float32, or more than 100000000"),
    "a return at NaN": (broken_point, "", "1 of 316 points are NaN"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_each_damage_is_said_with_its_file_and_a_remedy(name, drive):
    damage, file, said = DAMAGES[name]
    damage(drive)
    with unchecked():
        problems = NuScenesReader(root=drive.root).check()
    assert said in problems[0].message
    assert not file or problems[0].path.name == f"{file}.json"
    assert problems[0].remedy
    # An image of another size is one for each image of the camera.
    assert len(problems) == (3 if name == "an image of another camera" else 1)


def test_without_lidar_sweeps_may_be_missing(drive):
    sweep(drive).unlink()
    assert NuScenesReader(root=drive.root, lidar=False).check() == []


@pytest.mark.slow
def test_tables_with_some_bytes_changed_are_read_or_refused(drive):
    """Never another exception, and never a hang."""
    generator = random.Random(0)
    refused = 0
    with unchecked():
        for _ in range(150):
            path = drive.table(generator.choice([name for name in TABLES if name not in ("log", "map", "visibility")]))
            before = path.read_bytes()
            damaged = bytearray(before)
            for _ in range(generator.choice([1, 3, 10])):
                damaged[generator.randrange(len(damaged))] = generator.choice(b'{}[]",:09-.eE\\u\x00\xff \n')
            path.write_bytes(
                damaged[: generator.choice([len(damaged), len(damaged), generator.randrange(len(damaged))])]
            )
            try:
                NuScenesReader(root=drive.root).recording()
            except ValueError:  # LogError is one
                refused += 1
            path.write_bytes(before)
    assert 100 < refused < 150


def test_an_image_that_is_changed_later_is_found_when_it_is_decoded(drive):
    log = NuScenesReader(root=drive.root).read()
    Image.new("RGB", (30, 24)).save(image(drive))
    with pytest.raises(LogError, match=r"the image is 30x24, sample_data\.json says 32x24"):
        log.frames[2]
