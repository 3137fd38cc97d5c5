"""Logs that are written as nuScenes publishes them, and read again."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.nuscenes import NuScenesReader, NuScenesWriter
from sparsestreet.types import Shutter
from tests.data.nuscenes.written import write_nuscenes
from tests.data.plan import Plan
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

EXACT = NuScenesWriter(jpeg_quality=None)
CHANNELS = {0: "CAM_FRONT", 1: "CAM_FRONT_LEFT", 2: "CAM_FRONT_RIGHT"}
LATER = 2_000_000_000
"""The first image of the street is taken 30 ms before its clock starts, and no stamp is written below 1 s."""


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> DrivingLog:
    return street(tmp_path_factory)


@pytest.fixture(scope="module")
def root(log, tmp_path_factory) -> Path:
    return written(EXACT, log, tmp_path_factory.mktemp("nuscenes") / "street")


@pytest.fixture(scope="module")
def back(root) -> DrivingLog:
    return NuScenesReader(root=root).read()


def unseen(log: DrivingLog) -> set[str]:
    """Objects that no return hits at any frame."""
    hit = set()
    for sweep in log.sweeps.gray():
        for track in log.tracks:
            for frame, pose in zip(track.frames.tolist(), track.world_from_object, strict=True):
                local = (sweep.points.double() - pose[:3, 3]) @ pose[:3, :3]
                if frame == sweep.index and (local.abs() <= track.size / 2).all(1).any():
                    hit.add(track.name)
    return {track.name for track in log.tracks} - hit


def test_a_street_is_as_it_was(log, back):
    pairs = matching(log, back, CHANNELS)
    check_cameras(log, back, pairs)
    check_stamps(pairs, LATER)
    assert all(torch.equal(other.image, one.image) for one, other in pairs)
    check_points(log, back, LATER)
    check_boxes(log, back, {}, unseen(log))
    assert {track.name: track.class_name for track in back.tracks} == {
        track.name: {"Vehicle": "vehicle.car", "Cyclist": "vehicle.bicycle"}.get(
            track.class_name, "human.pedestrian.adult"
        )
        for track in log.tracks
        if track.name not in unseen(log)
    }


def test_its_masks_lie_beside_it(log, root):
    back = NuScenesReader(root=root, masks=root / "masks").read()
    for one, other in matching(log, back, CHANNELS):
        for kind in ("sky", "human", "vehicle"):
            assert torch.equal(getattr(other, kind), getattr(one, kind))
        assert other.ego is None
    plain = {file.path for file in NuScenesWriter(masks=False).files(log)}
    assert not any(path.startswith("masks") for path in plain)


def test_what_is_lost_of_it(log):
    assert EXACT.losses(log) == (
        "all stamps are 2 s later: the layout has none before 0",
        "3 cameras get names of the layout: 0 is CAM_FRONT, 1 is CAM_FRONT_LEFT, 2 is CAM_FRONT_RIGHT",
        "3 classes get names of the layout: Cyclist is vehicle.bicycle, Pedestrian is human.pedestrian.adult, "
        "Vehicle is vehicle.car",
        "the body poses of 1 objects are lost",
        f"{len(unseen(log))} of {len(log.tracks)} objects hold no return at any instant: readers leave them out",
    )


def test_jpegs_are_off_by_little(log, tmp_path):
    back = NuScenesReader(root=written(NuScenesWriter(), log, tmp_path)).read()
    for one, other in matching(log, back, CHANNELS):
        # Edges of one pixel in 8 x 8 blocks, at quality 95.
        assert (other.image.int() - one.image.int()).abs().float().mean() < 3
    assert len(list((tmp_path / "samples/CAM_FRONT").glob("*.jpg"))) == 3


def test_published_tables_are_as_they_were(tmp_path):
    """Poses of each image, objects' tokens and channels; boxes and sweeps at 50 ms behind the frame."""
    write_nuscenes(tmp_path / "first", Plan())
    log = NuScenesReader(root=tmp_path / "first").read()
    assert EXACT.losses(log) == ()
    back = NuScenesReader(root=written(EXACT, log, tmp_path / "second")).read()
    pairs = matching(log, back, dict(enumerate(log.camera_names)))
    # 4 km from the origin float64 has steps of 1e-12 m; the log's poses are float32.
    check_cameras(log, back, pairs)
    check_stamps(pairs)
    check_points(log, back)
    check_boxes(log, back, {})
    assert (back.name, back.camera_names, back.stamps) == (log.name, log.camera_names, log.stamps)
    assert [track.class_name for track in back.tracks] == ["vehicle.car"]
    assert NuScenesReader(root=tmp_path / "second").check() == []


def test_boxes_of_several_instants_are_moved_to_one(log, tmp_path):
    """The first object's boxes are 10 ms late; most have the stamp of the frame."""
    scale = 1 / (0.2 + 0.02 + 0.03)  # of seconds, from the earliest image to the latest
    first, *others = log.tracks
    late = replace(log, tracks=(replace(first, times=there(first.times) + 0.01 * scale), *others))
    back = NuScenesReader(root=written(EXACT, late, tmp_path)).read()
    (moved,) = (track for track in back.tracks if track.name == first.name)
    assert torch.equal(there(moved.times), next(there(one.times) for one in back.tracks if len(one.frames) == 3))
    speed = (first.world_from_object[1] - first.world_from_object[0])[:3, 3] / 0.1
    wanted = places(late, first)[:, :3, 3] - 0.01 * speed
    assert speed.norm() > 1
    # The car does not drive at one speed.
    torch.testing.assert_close(places(back, moved)[:, :3, 3], wanted, rtol=0, atol=5e-3)
    assert "3 boxes are moved to the instants of the layout, up to 10 ms away from their own" in EXACT.losses(late)


def test_a_lens_is_taken_out(log, tmp_path):
    lens = torch.tensor([0.2, 0.05, 0.001, -0.002, 0.0])
    bent = with_cameras(log, distortion=lens)
    root = written(EXACT, bent, tmp_path)
    back = NuScenesReader(root=root, masks=root / "masks").read()
    for one, other in matching(bent, back, CHANNELS):
        matrix = one.camera.intrinsics.double().numpy() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        wanted = cv2.undistort(one.image.numpy(), matrix, lens.double().numpy())
        # OpenCV rounds places to a 32nd of a pixel in two ways, at edges of up to 255 levels.
        assert np.abs(other.image.numpy().astype(int) - wanted).mean() < 1
        assert other.camera.distortion is None
        # What the pinhole sees beside the recorded image: OpenCV's picture is black there.
        assert (wanted[there(other.ego).numpy()].min(-1) < 5).any()
        assert not other.ego[8:-8, 12:-12].any()
    assert EXACT.losses(bent)[2].startswith("the lenses of 3 cameras, which move pixels by up to")


def test_a_shutter_is_lost(log):
    rolling = Shutter(torch.tensor([0.0, 0.0, 0.6]), torch.zeros(3))
    losses = EXACT.losses(with_cameras(log, shutter=rolling))
    assert "the rolling shutters of 9 images are lost, in whose readout the camera moves by up to 0.6 m" in losses


def test_without_lidar_all_objects_are_kept(log, tmp_path):
    back = NuScenesReader(root=written(EXACT, replace(log, sweeps=Sweeps.of(())), tmp_path)).read()
    check_boxes(log, back, {})
    assert len(back.sweeps) == 0


def test_a_log_without_a_clock(tmp_path):
    log = make_log(num_frames=3)
    assert EXACT.losses(log)[0].startswith("the log has no clock")
    back = NuScenesReader(root=written(EXACT, log, tmp_path)).read()
    assert back.stamps == {0: 1_000_000_000, 1: 1_100_000_000, 2: 1_200_000_000}
    assert [frame.image[0, 0, 0].item() for frame in back.frames] == [0, 1, 10, 11, 20, 21]
    assert back.camera_names == ("CAM_FRONT", "CAM_FRONT_LEFT")
    assert "0 is CAM_FRONT, 1 is CAM_FRONT_LEFT" in " ".join(EXACT.losses(log))


def test_a_camera_has_one_lens(log):
    frames = list(log.frames)
    frames[4] = replace(frames[4], camera=replace(frames[4].camera, intrinsics=2 * frames[4].camera.intrinsics))
    with pytest.raises(ValueError, match="camera 1 has another lens or size at frame 1"):
        list(EXACT.files(replace(log, frames=as_frames(frames))))


def test_returns_near_the_lidar_are_counted(log):
    (sweep, *others) = log.sweeps
    near = replace(sweep, points=sweep.points.clone())
    near.points[:7] = log.frames[0].camera.position
    losses = EXACT.losses(replace(log, sweeps=Sweeps.of((near, *others))))
    total = sum(len(one.points) for one in log.sweeps)
    assert any(loss.startswith(f"7 of {total} returns lie within 2.5 m of where the lidar is put") for loss in losses)


def test_a_camera_that_looks_back_gets_rows_of_the_recording_car(log):
    """Where it had another name before."""
    turned = []
    for frame in log.frames:
        if frame.indices[1] == 2:
            back = frame.camera.camera_from_world.clone()
            first = next(one for one in log.views if one.indices == (frame.indices[0], 0)).camera.camera_from_world
            back[:3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0])) @ first[:3, :3]
            turned.append(replace(frame, camera=replace(frame.camera, camera_from_world=back)))
        else:
            turned.append(frame)
    losses = EXACT.losses(replace(log, frames=as_frames(turned)))
    assert "readers take the lowest rows of CAM_BACK for the recording car's" in losses


def test_stamps_are_rounded_to_microseconds(log, tmp_path):
    frames = [replace(frame, stamp=(frame.stamp or 0) + 700 * (frame.indices[1] == 1)) for frame in log.frames]
    late = replace(log, frames=as_frames(frames), tracks=())
    assert "the stamps of 3 of 9 images are rounded to whole 1000 ns" in EXACT.losses(late)
    back = NuScenesReader(root=written(EXACT, late, tmp_path)).read()
    assert {frame.indices: (frame.stamp or 0) % 1_000_000 for frame in back.frames} == {
        frame.indices: 1000 * (frame.indices[1] == 1) for frame in late.frames
    }
