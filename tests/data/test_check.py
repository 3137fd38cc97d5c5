"""What the command prints."""

import io

import pytest
from rich.console import Console

from sparsestreet.data.check import report_check
from sparsestreet.data.drivestudio import DriveStudioReader
from tests.data.drivestudio.folders import make_nuscenes, make_waymo


@pytest.fixture
def console() -> Console:
    return Console(file=io.StringIO(), width=200)


@pytest.mark.parametrize("make", [make_nuscenes, make_waymo])
def test_a_sound_log_is_summed_up(make, tmp_path, console):
    assert report_check(DriveStudioReader(make(tmp_path)), console) == 0
    printed = console.file.getvalue()
    words = "3 x 2", "40x24", "15 points in 3 sweeps", "frames a second  │ 10 ", "0.2 s;", "Vehicle", "ready to train"
    assert [word for word in words if word not in printed] == []


def test_what_is_absent_is_said(tmp_path, console):
    make_nuscenes(tmp_path)
    for path in (tmp_path / "instances").iterdir():
        path.unlink()
    (tmp_path / "instances").rmdir()
    assert report_check(DriveStudioReader(tmp_path), console) == 0
    assert "no boxes" in console.file.getvalue()


def test_every_problem_is_printed_with_its_remedy(tmp_path, console):
    make_nuscenes(tmp_path, frames=12)
    for frame in range(9):
        (tmp_path / f"lidar_pose/{frame:03d}.txt").write_text("[bold] 1 2\n")
    assert report_check(DriveStudioReader(tmp_path), console) == 1
    printed = console.file.getvalue()
    assert "9 to repair" in printed
    for frame in range(9):
        assert f"lidar_pose/{frame:03d}.txt" in printed
    assert "write numbers separated by spaces" in printed


def test_a_folder_that_is_not_there_is_a_problem(tmp_path, console):
    assert report_check(DriveStudioReader(tmp_path / "nowhere"), console) == 1
    assert "nothing is there" in console.file.getvalue()
