"""What the command prints."""

import io
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from sparsestreet.data.check import report_check
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.hood import check_used
from sparsestreet.data.lazy import as_frames
from sparsestreet.data.log import split
from tests.data.drivestudio.folders import make_nuscenes, make_waymo
from tests.data.plan import make_log

SPLIT = partial(split, offset=1)
"""Three frames are enough for it."""


@pytest.fixture
def console() -> Console:
    return Console(file=io.StringIO(), width=200)


@pytest.mark.parametrize("make", [make_nuscenes, make_waymo])
def test_a_sound_log_is_summed_up(make, tmp_path, console):
    assert report_check(DriveStudioReader(make(tmp_path)), console, SPLIT) == 0
    printed = console.file.getvalue()
    words = "3 x 2", "40x24", "15 points in 3 sweeps", "frames a second  │ 10 ", "0.2 s;", "Vehicle", "ready to train"
    assert [word for word in words if word not in printed] == []


def test_what_is_absent_is_said(tmp_path, console):
    make_nuscenes(tmp_path)
    for path in (tmp_path / "instances").iterdir():
        path.unlink()
    (tmp_path / "instances").rmdir()
    assert report_check(DriveStudioReader(tmp_path), console, SPLIT) == 0
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


def test_a_problem_is_one_line_however_narrow_the_console(tmp_path):
    make_nuscenes(tmp_path)
    name = next((tmp_path / "images").iterdir())
    name.write_bytes(b"no image")
    printed = io.StringIO()
    assert report_check(DriveStudioReader(tmp_path), Console(file=printed, width=30)) == 1
    lines = printed.getvalue().splitlines()
    assert [line for line in lines if line.startswith(f"images/{name.name}:")] == lines[:1]
    assert lines[-1] == f"1 to repair in {tmp_path}; repair these first: more may be found then"


def test_a_log_of_which_nothing_can_be_held_out_is_not_ready(tmp_path, console):
    reader = DriveStudioReader(make_nuscenes(tmp_path), last_frame=0)
    assert report_check(reader, console) == 1
    printed = console.file.getvalue()
    assert "not ready to train: split.offset 5 lies behind the 1 frame of" in printed
    assert "lower split.offset, or say split.stride=0 to train on every frame" in printed
    assert "in 1 sweep (" in printed
    assert report_check(reader, console, partial(split, stride=0)) == 0
    assert "\nready to train: " in console.file.getvalue()


def test_a_folder_that_is_not_there_is_a_problem(tmp_path, console):
    assert report_check(DriveStudioReader(tmp_path / "nowhere"), console) == 1
    assert "nothing is there" in console.file.getvalue()


@pytest.mark.parametrize("share", [1.0, 0.99])
def test_masks_that_leave_nothing_are_named(share, tmp_path, console, recwarn):
    make_nuscenes(tmp_path)
    (tmp_path / "ego_masks").mkdir()
    mask = np.full((24, 40), 255, np.uint8)
    mask.reshape(-1)[round(share * mask.size) :] = 0
    for camera in range(2):
        Image.fromarray(mask).save(tmp_path / f"ego_masks/{camera}.png")
    assert report_check(DriveStudioReader(tmp_path), console, SPLIT) == (share == 1)
    said = {1.0: "6 of 6 images of", 0.99: "masks or alpha leave 1 % of the pixels of camera 0 to be used"}
    assert said[share] in console.file.getvalue()
    assert not recwarn


def test_a_street_without_a_used_pixel_is_not_trained(tmp_path):
    log = make_log(4)
    dark = as_frames([replace(frame, ego=torch.ones(frame.image.shape[:2], dtype=torch.bool)) for frame in log.frames])
    with pytest.raises(ValueError, match=r"8 of 8 images of .* have no pixel that is used, because masks or alpha"):
        check_used(dark, log.name)
    check_used(as_frames([*dark, *log.frames]), log.name)
