"""Images and points are read when they are asked for, once while there is room, and are the same every time."""

import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import ImageFile

from sparsestreet.data.drivestudio import DriveStudioReader, contents
from sparsestreet.data.log import split
from sparsestreet.types import Frame, Sweep
from tests.data.drivestudio.folders import make_nuscenes, make_waymo, write_image

FLAVOURS = pytest.mark.parametrize("make", [make_nuscenes, make_waymo])


@pytest.fixture
def decoded(monkeypatch) -> Counter[str]:
    """How often each image was decoded."""
    counts: Counter[str] = Counter()

    def count(path: Path, *arguments):
        counts[path.stem] += 1
        return read_image(path, *arguments)

    read_image = contents.read_image
    monkeypatch.setattr(contents, "read_image", count)
    return counts


def same_frame(frame: Frame, other: Frame) -> bool:
    parts = [(frame.image, other.image), (frame.sky, other.sky), (frame.human, other.human)]
    parts += [(frame.vehicle, other.vehicle), (frame.depth, other.depth)]
    return all(torch.equal(*part) for part in parts)


def same_sweep(sweep: Sweep, other: Sweep) -> bool:
    parts = [(sweep.points, other.points), (sweep.colors, other.colors), (sweep.colored, other.colored)]
    return all(torch.equal(*part) for part in parts)


@FLAVOURS
def test_opening_splitting_and_measuring_a_log_decodes_no_image(make, tmp_path, monkeypatch):
    def load(image: ImageFile.ImageFile) -> None:
        raise AssertionError(f"{image.filename} was decoded")

    monkeypatch.setattr(ImageFile.ImageFile, "load", load)
    log = DriveStudioReader(make(tmp_path, frames=6)).read()
    parts = split(log, stride=3, offset=1)
    assert log.radius > 0
    assert (len(log.views), len(parts.train), parts.held_out_indices) == (12, 8, {1, 4})
    assert len(log.frames[2:5]) == 3
    with pytest.raises(AssertionError, match=r"000_0\.(jpg|png) was decoded"):
        log.frames[0]


def test_each_image_is_decoded_once_while_there_is_room(tmp_path, decoded):
    log = DriveStudioReader(make_nuscenes(tmp_path)).read()
    first = list(log.frames)
    for frame, again in zip(first, log.frames, strict=True):
        assert same_frame(frame, again)
    assert len(list(log.sweeps)) == 3
    assert set(decoded.values()) == {1}
    assert len(decoded) == 6


def test_sweeps_leave_the_images_that_color_them_for_the_frames(tmp_path, decoded):
    log = DriveStudioReader(make_nuscenes(tmp_path)).read()
    assert log.sweeps[1].colored.any()
    assert set(decoded) == {"001_0", "001_1"}
    assert log.frames[2].frame_index == 1
    assert set(decoded.values()) == {1}


@FLAVOURS
def test_without_room_everything_is_read_anew_and_the_same(make, tmp_path, decoded):
    log, forgetful = DriveStudioReader(make(tmp_path)).read(), DriveStudioReader(tmp_path, cache_mb=0).read()
    for index in (5, 0, 3, 0):
        assert same_frame(forgetful.frames[index], log.frames[index])
        assert forgetful.frames[index] is not forgetful.frames[index]
    for index in (2, 0, 2):
        assert same_sweep(forgetful.sweeps[index], log.sweeps[index])
    # Once for log; for the other three times at each visit of frame 0, and once for the sweep.
    assert decoded["000_0"] == 1 + 2 * 3 + 1


@FLAVOURS
def test_a_gray_sweep_is_the_sweep_without_its_colors(make, tmp_path):
    """The vehicle passes the points that stand around, so that the cameras of an instant see others than the first."""
    log = DriveStudioReader(make(tmp_path, frames=10)).read()
    for gray, sweep in zip(log.sweeps.gray(), log.sweeps, strict=True):
        assert (gray.index, gray.points.tolist()) == (sweep.index, sweep.points.tolist())
        assert torch.equal(gray.colored, sweep.colored)
    assert len({int(gray.colored.sum()) for gray in log.sweeps.gray()}) > 1


MEASURE = """
import re, sys
import torch
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.log import split

def resident(name):
    return int(re.search(name + r":\\s+(\\d+) kB", open("/proc/self/status").read())[1]) * 1024

torch.set_num_threads(1)
before = resident("VmRSS")
log = DriveStudioReader(sys.argv[1], cache_mb=16).read()
parts = split(log)
assert log.radius > 0
opened = resident("VmHWM") - before
assert sum(int(frame.sky.sum()) for frame in parts.train) > 0
assert sum(len(sweep.points) for sweep in log.sweeps) > 0
print(opened, resident("VmHWM") - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak of memory from Linux' /proc")
def test_a_log_takes_no_more_memory_than_its_cache_and_its_points(tmp_path):
    make_nuscenes(tmp_path, frames=60)
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    for suffix, content in ((".jpg", pixels), (".png", 255 * (pixels[..., 0] > 127).astype(np.uint8))):
        write_image(tmp_path / f"large{suffix}", content)
        for image in tmp_path.rglob(f"*_[01]{suffix}"):
            shutil.copy(tmp_path / f"large{suffix}", image)
    measured = subprocess.run([sys.executable, "-c", MEASURE, tmp_path], capture_output=True, text=True, check=True)
    opened, used = map(int, measured.stdout.split())
    # All 120 frames of 480x320 take 184 MB decoded. Opening decodes none; 16 MB are cached then, and what a frame
    # in the making and the first calls into Pillow and torch take is added to both.
    assert opened < 30e6
    assert 16e6 < used < 70e6
