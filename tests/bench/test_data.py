"""Waits for frames, and the drive that they are of."""

import numpy as np
import pytest
from PIL import Image

from sparsestreet.bench import data
from sparsestreet.bench.made_up import MadeUpDrive
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.data.drivestudio import DriveStudioReader
from tests.bench.test_records import PROVENANCE

TINY = MadeUpDrive(3, 48, 32, 400)


def test_waits_are_those_before_the_steps(monkeypatch):
    """Frames that take 1, 2 and 6 ms, on a clock on which steps take 5 ms."""
    now = [0.0]

    def frames():
        for milliseconds in (1, 2, 6):
            now[0] += 1e-3 * milliseconds
            yield milliseconds

    def sleep(seconds):
        assert seconds == pytest.approx(5e-3)
        now[0] += seconds

    monkeypatch.setattr(data.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(data.time, "sleep", sleep)
    waits = data._waits(frames())
    assert waits == pytest.approx([1, 2, 6])
    record = data._record(48, 2, waits, 0.012)
    assert (record.width, record.epoch, record.steps, record.step_ms) == (48, 2, 3, 5.0)
    assert (record.wait_ms, record.median_ms, record.cpu_ms) == pytest.approx((3, 2, 4))
    assert record.share == pytest.approx(9 / 24)


def test_every_epoch_of_both_sizes_has_a_record(tmp_path, monkeypatch):
    monkeypatch.setattr(data, "STEP_MS", 0.0)
    monkeypatch.setattr(data, "EPOCHS", 2)
    file, said = RecordFile(tmp_path / "data.jsonl", PROVENANCE), []
    data.run_data(TINY, tmp_path, file, said.append)
    records = read_records(file.path)
    assert [(one["width"], one["epoch"], one["steps"]) for one in records] == [
        (24, 0, 3), (24, 1, 3), (48, 0, 3), (48, 1, 3),
    ]  # fmt: skip
    assert all(one["wait_ms"] > 0 and one["peak_mb"] > 50 for one in records)
    assert said[0] == f"writing 3 images of 48x32 into {tmp_path / 'drive_3x48x32'}"
    assert said[1].startswith("24 px, epoch 0: a step waits ")
    data.run_data(TINY, tmp_path, file, said.append)
    assert sum(line.startswith("writing") for line in said) == 1


def test_a_made_up_drive_is_a_log_with_all_that_costs_time(tmp_path):
    TINY.write(tmp_path / "drive", lambda line: None)
    reader = DriveStudioReader(tmp_path / "drive")
    assert reader.check() == []
    frames = list(reader.read().frames)
    assert len(frames) == 3
    for frame in frames:
        assert frame.sky is not None
        assert frame.depth is not None
        assert (frame.human is None, frame.vehicle is None) == (False, False)
        assert 20 < int((frame.depth > 0).sum()) < 400
    assert not np.array_equal(frames[0].image, frames[1].image)


def test_images_have_the_bytes_of_photographs(tmp_path):
    """A JPEG of quality 85 takes some 2 to 4 bits a pixel of a street; one color would take 0.05."""
    MadeUpDrive(1, 480, 320, 10).write(tmp_path / "drive", lambda line: None)
    path = tmp_path / "drive/images/000_0.jpg"
    with Image.open(path) as image:
        width, height = image.size
    assert 2 < 8 * path.stat().st_size / (width * height) < 5
