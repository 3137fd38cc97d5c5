"""The recorded drive in DriveStudio's layout, converted from that layout and from nuScenes' tables."""

from pathlib import Path

import pytest
import torch

from sparsestreet.data.convert import Source, convert
from sparsestreet.data.drivestudio import DriveStudioReader, DriveStudioWriter
from sparsestreet.data.drivestudio.annotations import class_in
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.nuscenes import NuScenesReader
from tests.data.same_log import check_same_masks, check_same_sweeps, check_same_track, check_same_views

pytestmark = pytest.mark.lengthy

FRAMES = 12


def check_converted(log: DrivingLog, folder: Path) -> None:
    """Frames, poses, returns and boxes of what is written and read again."""
    convert(log, Source(log.name, "0" * 12), DriveStudioWriter(jpeg_quality=None), folder)
    assert DriveStudioReader(folder).check() == []
    found = DriveStudioReader(folder).read()
    check_same_views(found, log)
    check_same_sweeps(found, log)
    moved = 0
    for one, other in zip(found.frames, log.frames, strict=True):
        assert torch.equal(one.image, other.image)
        check_same_masks(one, other)
        assert one.depth is not None
        assert other.depth is not None
        moved += int(((one.depth - other.depth).abs() > 1e-4).sum())
    # Returns are rounded to 4 micrometers: of 400,000 few lie so near to the border of a pixel.
    assert moved < 40
    known = [class_in("nuscenes", track.class_name) for track in log.tracks]
    assert [track.class_name for track in found.tracks] == known
    for one, other in zip(found.tracks, log.tracks, strict=True):
        check_same_track(found, one, log, other)
    assert found.radius == pytest.approx(log.radius, rel=1e-6)


def test_drivestudios_layout(kitti, tmp_path):
    log = DriveStudioReader(kitti, last_frame=FRAMES - 1).read()
    check_converted(log, tmp_path / "out")


def test_nuscenes_tables(recorded, tmp_path):
    reader = NuScenesReader(root=recorded("kitti_0001_nuscenes"), principal_shift=0, last_frame=FRAMES - 1)
    check_converted(reader.read(), tmp_path / "out")
