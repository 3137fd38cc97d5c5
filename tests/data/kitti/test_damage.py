"""Broken drives: one clear error that names the file, or a counted note."""

import shutil
from pathlib import Path

import pytest

from sparsestreet.data.kitti import KittiReader
from sparsestreet.data.kitti.files import read_points
from sparsestreet.data.kitti.reader import read_tracklets
from sparsestreet.data.problems import LogError
from tests.data.damage import (
    LAUGHS,
    assert_found,
    cut,
    daily,
    gone,
    line,
    long,
    png,
    refusals,
    replaced,
    word,
    written,
)
from tests.data.kitti.write import DRIVE, write_kitti
from tests.data.plan import Plan
from tests.shared import made_once

PLAN = Plan()
CAMERAS, LIDAR, IMU = "../calib_cam_to_cam.txt", "../calib_velo_to_cam.txt", "../calib_imu_to_velo.txt"
IMAGE, SWEEP, OXTS = "image_02/data/0000000001.png", "velodyne_points/data/0000000001.bin", "oxts/data/0000000001.txt"
STAMPS, START, XML = "velodyne_points/timestamps.txt", "velodyne_points/timestamps_start.txt", "tracklet_labels.xml"
DAMAGES = {
    "no calibration of the cameras": (CAMERAS, gone, "missing"),
    "no line P_rect": (CAMERAS, replaced("P_rect_03", "P_rekt_03"), "no line 'P_rect_03'"),
    "NaN in P_rect": (CAMERAS, replaced("P_rect_03: 30.0", "P_rect_03: nan"), "NaN or infinity"),
    "no pinhole": (CAMERAS, replaced("P_rect_03: 30.0 0.0", "P_rect_03: 30.0 1.0"), "no [K | p] of a pinhole"),
    "negative focal length": (CAMERAS, replaced("P_rect_02: 30.0", "P_rect_02: -30.0"), "no [K | p] of a pinhole"),
    "no rotation": (CAMERAS, replaced("R_rect_00: 0.9", "R_rect_00: 0.8"), "no rigid transform"),
    "size of nothing": (CAMERAS, replaced("S_rect_02: 32", "S_rect_02: 0"), "no size of an image"),
    "binary calibration": (CAMERAS, written(bytes(range(128, 256))), "cannot be read"),
    "scaled mount": (LIDAR, line(1, "R: 2 0 0 0 2 0 0 0 2"), "no rigid transform"),
    "no image": (IMAGE, gone, "the file is missing"),
    "torn image": (IMAGE, cut, "cannot be decoded"),
    "low image": (IMAGE, png(32, 12), "the image is 32x12, its calibration is for 32x24"),
    "no pose": (OXTS, gone, "the file is missing"),
    "two poses in a file": (OXTS, lambda path: path.write_text(2 * path.read_text()), "this file has 60"),
    "NaN in a pose": (OXTS, word(4, "nan"), "NaN or infinity"),
    "latitude of no place": (OXTS, replaced("49.0", "149.0"), "the latitude 149"),
    "another country": (OXTS, replaced("49.0", "47.0"), "poses span"),
    "endless pose": (OXTS, long(1 << 40), "more than the"),
    "half a row of points": (SWEEP, lambda path: path.write_bytes(path.read_bytes()[:-7]), "no whole number of rows"),
    "NaN among points": (SWEEP, lambda path: path.write_bytes(path.read_bytes() + 4 * b"\x00\x00\xc0\x7f"), "1 of"),
    "endless sweep": (SWEEP, long(1 << 40), "more than"),
    "no stamp": (STAMPS, line(3, "today"), "line 4 is 'today'"),
    "a date of no calendar": (STAMPS, line(3, "2011-02-30 13:00:00.5"), "no calendar"),
    "a time of no clock": (STAMPS, line(3, "2011-02-03 25:00:00.5"), "no clock"),
    "stamps go back": (STAMPS, line(3, "2011-02-03 13:00:00.5"), "line 4, of frame 3, is not later"),
    "no start of a turn": (START, line(1, ""), "frame 1 has a sweep, and no stamp here"),
    "a turn of a day": (START, line(1, "2018-07-23 03:28:47.5"), "no second around"),
    "torn XML": (XML, cut, "no XML"),
    "entities": (XML, replaced("<!DOCTYPE boost_serialization>", LAUGHS), "EntitiesForbidden"),
    "endless XML": (XML, long(1 << 40), "more than the"),
    "deep XML": (XML, written(b"<a>" * 100_000), "more than 64 deep"),
    "an encoding of nobody": (XML, replaced("UTF-8", "klingon"), "no XML"),
    "an object too few": (XML, replaced("<count>2</count>", "<count>3</count>"), "announces 3.0 objects and holds 2"),
    "no class": (XML, replaced("<objectType>Car</objectType>", ""), "has the class ''"),
    "no height": (XML, replaced("<h>1.6</h>", ""), "lacks h"),
    "a height of nothing": (XML, replaced("<h>1.6</h>", "<h>0</h>"), "0 m high"),
    "no place": (XML, replaced("<tx>", "<ux>", 1), "no XML"),
    "a negative frame": (XML, replaced("<first_frame>0", "<first_frame>-3"), "the first frame -3"),
    "far away": (XML, replaced("<tx>", "<tx>9999", 1), "farther than a lidar sees"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return made_once(tmp_path_factory, "kitti", lambda folder: write_kitti(folder, PLAN))


@pytest.mark.parametrize(
    "name", daily(DAMAGES, "NaN in P_rect", "torn image", "stamps go back", "torn XML", "entities")
)
def test_a_broken_file_is_named(name, whole, tmp_path):
    relative, damage, said = DAMAGES[name]
    shutil.copytree(whole, tmp_path / "root")
    folder = next(tmp_path.glob("root/*/*_sync"))
    path = (folder / relative).resolve()
    damage(path)
    assert_found(KittiReader(root=(tmp_path / "root").resolve(), drive=DRIVE), path, said)


def test_whatever_is_not_there_is_said(whole, tmp_path):
    with pytest.raises(LogError, match=f"there is no such drive; the drives in {whole} are 2011_09_26_drive_0099;"):
        KittiReader(root=whole, drive="2011_09_26_drive_0001").read()
    with pytest.raises(LogError, match="must be the folder of the dates"):
        KittiReader(root=tmp_path, drive=DRIVE).read()
    (tmp_path / "2011_09_26" / f"{DRIVE}_extract").mkdir(parents=True)
    with pytest.raises(LogError, match="only the unsynchronized, distorted recording"):
        KittiReader(root=tmp_path, drive=DRIVE).read()
    # A command line takes 1 for a number.
    for name in ("../../etc", "2011_09_26", "", 1):
        with pytest.raises(ValueError, match=r"a drive is named as 2011_09_26_drive_0001, got .* are 2011_.*_0099:"):
            KittiReader(root=whole, drive=name).read()
    with pytest.raises(ValueError, match=r"cameras \['image_07'\] must be different ones"):
        KittiReader(root=whole, drive=DRIVE, cameras=["image_07"]).read()
    with pytest.raises(ValueError, match="frames 2 to 9 are not within the log's 0 to 3"):
        KittiReader(root=whole, drive=DRIVE, first_frame=2, last_frame=9).read()


def test_the_only_drive_needs_no_name(whole, tmp_path):
    assert KittiReader(root=whole).read().name == DRIVE
    with pytest.raises(LogError, match="must be the folder of the dates"):
        KittiReader(root=tmp_path).read()
    for number in range(2):
        (tmp_path / f"2011_09_26/2011_09_26_drive_000{number}_sync").mkdir(parents=True)
    with pytest.raises(ValueError, match="are 2011_09_26_drive_0000, 2011_09_26_drive_0001: name one"):
        KittiReader(root=tmp_path).read()


@pytest.mark.slow
def test_nothing_but_problems_comes_of_random_bytes(whole, tmp_path):
    """In the two files that are no plain text: read, or one kind of error."""
    folder = next(whole.glob("*/*_sync"))
    for name, read in ((SWEEP, read_points), (XML, read_tracklets)):
        content = (folder / name).read_bytes()
        assert 20 < refusals(read, tmp_path / Path(name).name, content, count=150, seed=24) < 150
