"""``data=auto``: which reader a folder is for, and what is said where none or several know it."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from sparsestreet.cli.commands.train import train
from sparsestreet.cli.config.compose import CONF
from sparsestreet.cli.config.log_from_options import found_option, with_found_data
from tests.cli.configurations import composed

OPTIONS = {path.stem for path in (CONF / "data").glob("*.yaml") if "root" in set(OmegaConf.load(path))}
FILES = {
    "nuscenes": "v1.0-mini/sample_data.json",
    "kitti": "2011_09_26/2011_09_26_drive_0001_sync/image_02/data/0000000000.png",
    "kitti360": "data_2d_raw/2013_05_28_drive_0000_sync/image_00/data_rect/0000000000.png",
    "argoverse2": "val/7fab2350/city_SE3_egovehicle.feather",
    "pandaset": "001/camera/front_camera/poses.json",
    "waymo": "training/camera_image/1.parquet",
    "rig_json": "rig.json",
    "nerfstudio": "transforms.json",
    "colmap": "sparse/0/cameras.bin",
    "drivestudio": "images/000_0.jpg",
}
"""Of each option of conf/data a file that its data set has, and no other."""
FILES = {name: file for name, file in FILES.items() if name in OPTIONS}


def touch(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


def test_every_reader_of_a_folder_can_be_found():
    assert FILES.keys() == OPTIONS


@pytest.mark.parametrize("name", FILES)
def test_a_folder_is_known_by_a_file(name, tmp_path):
    found, why = found_option(touch(tmp_path, FILES[name]))
    assert found == name
    assert (tmp_path / FILES[name]).is_relative_to(why)


def test_the_options_of_the_reader_that_is_found_apply(tmp_path):
    words, said = with_found_data(["seed=3", "data=auto", f"data.root={touch(tmp_path, FILES['kitti'])}"])
    assert words == ["seed=3", "data=kitti", f"data.root={tmp_path}"]
    assert said == f"data=kitti, as {tmp_path}/2011_09_26/2011_09_26_drive_0001_sync tells"
    assert composed(*words).data == composed("data=kitti", f"data.root={tmp_path}", "seed=3").data


def test_a_folder_that_no_reader_knows_lists_what_each_missed(tmp_path):
    with pytest.raises(ValueError, match=rf"data.root={tmp_path} is an empty folder: name that of a log; [^\n]*$"):
        found_option(tmp_path)
    with pytest.raises(ValueError, match="no reader knows") as error:
        found_option(touch(tmp_path, "photo.jpg"))
    lines = str(error.value).splitlines()
    assert [line.split(":")[0].strip() for line in lines[1:]] == sorted(f"data={name}" for name in FILES)
    assert "  data=nuscenes: */sample_data.json" in lines
    assert "docs/datasets/README.md" in lines[0]


def test_a_folder_of_two_data_sets_names_both(tmp_path):
    touch(tmp_path, FILES["nerfstudio"], FILES["colmap"])
    with pytest.raises(ValueError, match=r"data=colmap .* and data=nerfstudio .*: name the one that is meant"):
        found_option(tmp_path)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("labels/1.egomotion.parquet", ("PhysicalAI-AV", "1.egomotion.parquet tells", "DracoPy", "data=rig_json")),
        ("calibration/camera_intrinsics.chunk_0003.parquet", ("PhysicalAI-AV", "data=rig_json")),
        ("scene.zarr.itar", ("NCore", "nvidia-ncore", "data=rig_json")),
    ],
)
def test_what_is_known_and_not_read_is_refused_with_a_remedy(file, words, tmp_path):
    with pytest.raises(ValueError, match="is not read") as error:
        found_option(touch(tmp_path, file))
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["data=auto"], "give data.root=DIR"),
        (["data=auto", "data.root={root}/nowhere"], "is not there"),
        (["data=auto", "data.root={root}/a.txt"], "is a file"),
        (["data=auto", "data.root=a,b"], "looks at one folder"),
        (["data=auto,kitti", "data.root=a"], "looks at one folder"),
    ],
)
def test_a_wrong_command_is_answered_before_anything_is_read(words, said, tmp_path, capsys):
    touch(tmp_path, "a.txt")
    assert train([word.replace("{root}", str(tmp_path)) for word in words]) == 2
    written = capsys.readouterr().err
    assert said in written
    assert written.startswith("sparsestreet train: ")
