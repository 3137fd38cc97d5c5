"""Images of a log, changed as a camera would, against numbers by hand."""

import cv2
import numpy as np
import pytest

from benchmarks.changed_images import Changes, changed, walk, write


def test_light_is_doubled_and_cut_off_at_white():
    # 118 of 255 is 18.1 % of the light, 36.2 % are 162; 190 is 51.5 % of it.
    assert changed(np.array([[[0, 118, 190]]], np.uint8), 1.0, 0.0).tolist() == [[[0, 162, 255]]]
    same = np.arange(256, dtype=np.uint8).reshape(1, -1, 1).repeat(3, 2)
    assert np.array_equal(changed(same, 0.0, 0.0), same)


def test_a_vignette_leaves_the_middle_and_takes_its_part_of_the_corners():
    image = changed(np.full((101, 201, 3), 118, np.uint8), 0.0, 0.5)
    assert image[50, 100].tolist() == [118] * 3
    # 9.1 % of the light are 85; the corner pixel's middle lies 1 % before the corner.
    assert image[0, 0, 0] == pytest.approx(85, abs=1)


def test_a_walk_has_its_size_and_is_smooth():
    ev = walk(400, 0.25, np.random.default_rng(1))
    assert ev.std() == pytest.approx(0.25)
    assert ev.mean() == pytest.approx(0, abs=1e-12)
    assert np.abs(np.diff(ev)).max() < 0.15
    assert not walk(9, 0.0, np.random.default_rng(1)).any()


def test_a_log_is_written_beside_the_old_one(tmp_path):
    log = tmp_path / "log"
    (log / "images").mkdir(parents=True)
    (log / "lidar").mkdir()
    for frame in range(3):
        cv2.imwrite(str(log / "images" / f"{frame:03d}_1.png"), np.full((16, 16, 3), 190 if frame else 60, np.uint8))
    # One of three images becomes white, but for what the walk takes: none.
    assert write(log, tmp_path / "out", Changes(mean=1.0)) == pytest.approx(2 / 3)
    assert sorted(path.name for path in (tmp_path / "out/images").iterdir()) == ["000_1.jpg", "001_1.jpg", "002_1.jpg"]
    assert (tmp_path / "out/lidar").resolve() == log / "lidar"
    with pytest.raises(FileExistsError):
        write(log, tmp_path / "out", Changes())
