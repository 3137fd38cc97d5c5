"""Scenes by name and by place, and the folder of tables."""

import shutil

import pytest

from sparsestreet.data.nuscenes import NuScenesReader
from sparsestreet.data.problems import LogError
from tests.conftest import unchecked
from tests.data.nuscenes.written import Written, write_nuscenes
from tests.data.plan import Plan


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Written:
    """scene-0061, which has files, at place 1 of three. Nobody changes it."""
    written = write_nuscenes(tmp_path_factory.mktemp("nuscenes") / "drive", Plan(num_frames=2))
    (row,) = written.rows("scene")
    names = ("scene-0001", "scene-0061", "scene-0002")
    written.write(
        "scene", [{**row, "name": name, "token": row["token"] if name == row["name"] else name} for name in names]
    )
    return written


def note(drive: Written, scene: str | int) -> str:
    return NuScenesReader(root=drive.root, scene=scene).recording().notes[0]


def test_by_name(drive):
    assert note(drive, "scene-0061") == "scene-0061 is read, at place 1 of v1.0-mini/scene.json"


def test_by_place_the_other_meaning_of_the_number_is_said(drive):
    assert note(drive, 1) == (
        "scene-0061 is read, at place 1 of v1.0-mini/scene.json, as data.log.scene=1 asks (DriveStudio counts so); for "
        "the scene whose name has this number say data.log.scene=scene-0001"
    )


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (None, "holds 3 scenes: name one, as data.log.scene=scene-0001; there are scene-0001, scene-0061, scene-0002"),
        ("scene-0103", "data.log.scene=scene-0103: no scene of .* has this name; there are scene-0001"),
        ("0061", "for the scene whose name has this number say data.log.scene=scene-0061"),
        (61, "place within 0 to 2 of scene.json; for the scene whose name .* data.log.scene=scene-0061"),
        (-1, "place within 0 to 2"),
        (True, "scene must be a name or a place"),
    ],
)
def test_a_scene_that_is_not_there_is_an_error_that_lists_those_that_are(drive, scene, said):
    with pytest.raises(ValueError, match=said):
        NuScenesReader(root=drive.root, scene=scene).recording()


def test_a_rate_that_is_none(drive):
    with unchecked(), pytest.raises(ValueError, match="rate must be one of keyframes, all, got '10hz'"):
        NuScenesReader(root=drive.root, rate="10hz")  # pyright: ignore[reportArgumentType]


def test_several_folders_of_tables(tmp_path):
    written = write_nuscenes(tmp_path / "drive", Plan(num_frames=2))
    shutil.copytree(written.root / "v1.0-mini", written.root / "v1.0-trainval")
    with pytest.raises(ValueError, match=r"tables of v1\.0-mini, v1\.0-trainval: say which, as data\.log\.version"):
        NuScenesReader(root=written.root).recording()
    assert NuScenesReader(root=written.root, version="v1.0-trainval").recording().name == "scene-0061"
    with pytest.raises(
        ValueError, match=r"data\.log\.version=v1\.0-test: .* holds no sample_data\.json; .* v1\.0-mini, v1\.0-trainval"
    ):
        NuScenesReader(root=written.root, version="v1.0-test").recording()


def test_a_folder_without_tables_says_which_one_is_meant(drive, tmp_path):
    with pytest.raises(LogError, match=r"holds no \*/sample_data\.json; name the folder that holds v1\.0-mini"):
        NuScenesReader(root=tmp_path).recording()
    with pytest.raises(LogError, match="name the one above"):
        NuScenesReader(root=drive.root / "v1.0-mini").recording()
    assert "no such folder" in NuScenesReader(root=tmp_path / "nowhere").check()[0].message
