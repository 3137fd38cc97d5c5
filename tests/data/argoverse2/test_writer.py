"""A log that is written in Argoverse 2's layout is read as it was, and what cannot be is said."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from sparsestreet.data.argoverse2 import Argoverse2Reader, Argoverse2Writer
from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.types import Shutter
from tests.conftest import unchecked
from tests.data.round_trip import (
    check_boxes,
    check_cameras,
    check_points,
    check_stamps,
    matching,
    places,
    street,
    with_cameras,
    written,
)
from tests.data.streets import make_log
from tests.typed import there

pytest.importorskip("pyarrow", reason="feather files need pyarrow")

from tests.data.argoverse2.write import write_log

NAMES = {0: "ring_front_center", 1: "ring_front_left", 2: "ring_front_right"}
SECOND = 1_000_000_000
EXACT = Argoverse2Writer(jpeg_quality=None, half=False)


@pytest.fixture(autouse=True, scope="module")
def _checks() -> Iterator[None]:
    """The parts have tests of their own, with checks of shapes."""
    with unchecked():
        yield


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> DrivingLog:
    """Images 20 ms after, at, and 30 ms before their sweep."""
    return street(tmp_path_factory)


@pytest.fixture(scope="module")
def root(log, tmp_path_factory) -> Path:
    return written(EXACT, log, tmp_path_factory.mktemp("av2"))


def test_a_street_comes_back_with_its_masks(log, root):
    reader = Argoverse2Reader(root=root, masks=root / log.name / "masks")
    assert reader.check() == []
    back = reader.read()
    pairs = matching(log, back, NAMES)
    assert (back.name, back.num_frames, len(pairs)) == (log.name, 3, 9)
    check_cameras(log, back, pairs)
    # The first image lies 30 ms before 0: stamps are moved by whole seconds, to 1 s at least.
    check_stamps(pairs, 2 * SECOND)
    for one, other in pairs:
        assert torch.equal(one.image, other.image)
        for kind in ("sky", "human", "vehicle"):
            assert torch.equal(getattr(one, kind), getattr(other, kind))
    # The layout's front camera shows its car; the street's does not.
    assert not any(other.ego.any() for _, other in pairs if other.indices[1] == 0)


def test_its_points_and_boxes_are_carried_to_the_stamps_of_sweeps_that_readers_take_the_images_of(log, root):
    """Those of the log would have the images of other sweeps: they lie up to 30 ms before them."""
    back = Argoverse2Reader(root=root).read()
    # Half a turn before the middle of the images, which are 20 ms after to 30 ms before the sweep's own stamp.
    assert [sweep.stamp for sweep in back.sweeps] == [
        there(one.stamp) + 2 * SECOND - 5_000_000 - 50_000_000 for one in log.sweeps
    ]
    from_log, later = log.tracks, {track.name: track for track in back.tracks}
    assert later.keys() == {track.name for track in from_log}
    for track in from_log:
        other = later[track.name]
        assert other.frames.tolist() == track.frames.tolist()
        if len(track.frames) == 3:
            # 55 ms earlier: on the line through the boxes, 0.1 s apart.
            steps = places(log, track)[1:, :3, 3] - places(log, track)[:-1, :3, 3]
            expected = places(log, track)[1:, :3, 3] - 0.55 * steps
            torch.testing.assert_close(places(back, other)[1:, :3, 3], expected, rtol=0, atol=1e-6)
    for one, other in zip(log.sweeps.gray(), back.sweeps.gray(), strict=True):
        away = (one.points.double() + log.dataset_from_world[:3, 3]) - (
            other.points.double() + back.dataset_from_world[:3, 3]
        )
        moved = away.norm(dim=1) > 1e-4
        # Points in the boxes of what drives; 20 m/s are 1.1 m in 55 ms.
        assert 0 < moved.sum() < len(one.points) / 4
        assert away.norm(dim=1).max() < 1.2
    said = " | ".join(EXACT.losses(log))
    assert "3 sweeps get stamps up to 55 ms away" in said
    assert "boxes are moved to the instants of the layout, up to 55 ms away from their own" in said


def test_a_drive_of_the_layout_itself_comes_back(tmp_path):
    """Which the tests' own writer wrote: its stamps stay, and the city 4 km from its origin."""
    drive = Argoverse2Reader(root=write_log(tmp_path / "first", points=np.float32)).read()
    back = Argoverse2Reader(root=written(EXACT, drive, tmp_path / "second")).read()
    pairs = matching(drive, back, {0: "ring_front_center", 1: "ring_front_left"})
    check_stamps(pairs)
    check_cameras(drive, back, pairs)
    check_points(drive, back)
    check_boxes(drive, back, {})
    assert all(torch.equal(one.image, other.image) and _same(one.ego, other.ego) for one, other in pairs)
    assert [track.class_name for track in back.tracks] == [track.class_name for track in drive.tracks]
    assert not [one for one in EXACT.losses(drive) if "sweeps get stamps" in one or "classes" in one or "mount" in one]


def _same(one: torch.Tensor | None, other: torch.Tensor | None) -> bool:
    return one is other or (one is not None and other is not None and torch.equal(one, other))


def test_points_in_float16(log, tmp_path):
    back = Argoverse2Reader(root=written(Argoverse2Writer(), log, tmp_path)).read()
    exact = Argoverse2Reader(root=written(EXACT, log, tmp_path / "exact")).read()
    # Steps are 2^-4 m from 64 to 128 m, of which a half is lost an axis.
    check_points(exact, back, atol=2**-5 + 1e-4)
    (said,) = [loss for loss in Argoverse2Writer().losses(log) if "float16" in loss]
    number = sum(len(sweep.points) for sweep in log.sweeps.gray())
    assert said.startswith(f"points are float16: {number} of them move by up to ")
    assert 1 < float(said.split("up to ")[1].split(" mm")[0]) <= 32


def test_what_is_lost_is_said(log):
    said = " | ".join(EXACT.losses(log))
    assert "3 cameras get names of the layout: 0 is ring_front_center" in said
    assert "classes get names of the layout: Cyclist is BICYCLIST" in said or "Vehicle is REGULAR_VEHICLE" in said
    assert "all stamps are 2 s later" in said
    assert "readers take the lowest rows of ring_front_center for the recording car" in said
    assert "images are passed over" not in said
    shutter = Shutter(torch.tensor([0.3, 0.0, 0.4]), torch.zeros(3))
    lens = torch.tensor([-0.1, 0.01, 0.0, 0.0, 0.0])
    said = " | ".join(EXACT.losses(with_cameras(log, shutter=shutter, distortion=lens)))
    assert "the rolling shutters of 9 images are lost, in whose readout the camera moves by up to 0.5 m" in said
    assert "the lenses of 3 cameras" in said


def test_a_log_without_clock_lidar_and_boxes(tmp_path):
    log = make_log(num_frames=3)
    back = Argoverse2Reader(root=written(EXACT, log, tmp_path), cameras=list(NAMES.values())[:2]).read()
    assert [view.stamp for view in back.views[::2]] == [SECOND, SECOND + 100_000_000, SECOND + 200_000_000]
    assert [len(sweep.points) for sweep in back.sweeps] == [0, 0, 0]
    assert back.tracks == ()
    assert "the log has no clock" in " ".join(EXACT.losses(log))


@pytest.mark.parametrize("period", [50_000_000, 500_000_000, 1_300_000_000])
def test_logs_of_other_rates_keep_their_frames(log, period, tmp_path):
    """Faster than a turn of the layout's lidar, and with longer gaps than its poses may have."""
    frames = [replace(one, stamp=period * one.indices[0], time=one.indices[0] / 2) for one in log.frames]
    sweeps = tuple(replace(one, stamp=period * one.index, time=one.index / 2) for one in log.sweeps)
    tracks = tuple(replace(one, times=one.frames.double() / 2) for one in log.tracks)
    other = replace(log, frames=as_frames(frames), sweeps=Sweeps.of(sweeps), tracks=tracks)
    back = Argoverse2Reader(root=written(EXACT, other, tmp_path)).read()
    assert (back.num_frames, len(back.views)) == (3, 9)
    check_stamps(matching(other, back, NAMES), SECOND)
    # They were taken 50 ms apart, in which the car sped up a little: equal stamps make that an error of the mounts.
    check_cameras(other, back, matching(other, back, NAMES), atol=2e-3)
    assert "each camera has one mount: poses of images are off by up to 0.00" in " | ".join(EXACT.losses(other))


def test_images_too_far_apart_for_one_sweep_are_counted(log):
    late = [replace(one, stamp=there(one.stamp) + 160_000_000 * (one.indices[1] == 1)) for one in log.frames]
    said = " | ".join(EXACT.losses(replace(log, frames=as_frames(late))))
    assert "of 9 images are passed over by readers: they are not next to their sweep" in said


def test_conf_layout_says_what_the_writer_takes_by_itself():
    config = OmegaConf.to_container(OmegaConf.load(Path(__file__).parents[3] / "conf/layout/argoverse2.yaml"))
    assert isinstance(config, dict)
    assert config.pop("_target_") == "sparsestreet.data.argoverse2.Argoverse2Writer"
    assert config == vars(Argoverse2Writer())


def test_bytes_are_equal_whenever_they_are_asked(log):
    for file in EXACT.files(log):
        assert b"".join(file.content()) == b"".join(file.content())
