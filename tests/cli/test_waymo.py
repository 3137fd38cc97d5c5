"""The command reads Waymo's files by its options."""

import pytest

from sparsestreet.cli.commands.data import data
from tests.data.waymo import records
from tests.data.waymo.drive import Drive

NAME = "10023947602400723454_1120_000_1140_000"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("waymo")
    for name in (NAME, "2"):
        records.write_drive(root, Drive(num_frames=3), name)
    (root / "list.txt").write_text(f"2\n{NAME}\n")
    return root


@pytest.mark.parametrize(
    "scene", [f"data.log.scene={NAME}", f"data.log.scene='{NAME}'", f"data.log.scene=segment-{NAME}_with_camera_labels"]
)
def test_a_segment_by_its_name_quoted_or_not(scene, root, capsys):
    assert data(["check", "data=waymo", f"data.root={root}", scene, "split.stride=0"]) == 0
    printed = capsys.readouterr().out
    assert "3 x 2" in printed
    assert NAME in printed


def test_a_segment_by_its_place_in_a_list(root, capsys):
    list_of_scenes = f"data.log.scenes={root}/list.txt"
    assert data(["check", "data=waymo", f"data.root={root}", "data.log.scene=1", list_of_scenes, "split.stride=0"]) == 0
    assert NAME in capsys.readouterr().out


def test_an_open_choice_is_an_error(root, capsys):
    assert data(["check", "data=waymo", f"data.root={root}"]) == 2
    assert "data.log.scene must name one of the segments" in capsys.readouterr().err
