"""Logs that are written as KITTI ships a drive, and read again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sparsestreet.data.kitti import KittiReader, KittiWriter
from sparsestreet.data.kitti.mercator import Mercator
from sparsestreet.data.kitti.oxts import read_oxts
from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.boxes import CarriedPoints, box_at
from sparsestreet.geometry.cameras import transform_points
from sparsestreet.types import Frame
from tests.data.kitti.write import DRIVE, write_kitti
from tests.data.plan import Plan
from tests.data.round_trip import (
    FLOAT32,
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
from tests.shared import made_once

WRITER = KittiWriter()
FIRST = "1970_01_01_drive_0001"
LATER = 2_000_000_000
"""The first image of the street is taken 30 ms before its clock starts, and no stamp is written below 1 s."""


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> DrivingLog:
    return street(tmp_path_factory)


@pytest.fixture(scope="module")
def ahead(log) -> DrivingLog:
    """Of the front camera alone, whose images are taken 20 ms behind the sweeps and boxes."""
    return replace(log, frames=log.frames.where(lambda view: view.camera_index == 0))


@pytest.fixture(scope="module")
def root(log, tmp_path_factory) -> Path:
    return written(WRITER, log, tmp_path_factory.mktemp("kitti") / "street")


@pytest.fixture(scope="module")
def back(root) -> DrivingLog:
    return KittiReader(root=root, drive=FIRST).read()


@pytest.fixture(scope="module")
def planned(tmp_path_factory) -> DrivingLog:
    """Two parallel cameras, a lidar and two objects, 6,000 km from the origin of Mercator's plane."""
    folder = made_once(tmp_path_factory, "kitti", lambda folder: write_kitti(folder, Plan()))
    return KittiReader(root=folder, drive=DRIVE).read()


def times_of_frames(log: DrivingLog) -> dict[int, float]:
    return {view.indices[0]: view.time for view in log.views}


def test_a_street_is_as_it_was_seen_ahead(ahead, back):
    pairs = matching(ahead, back, {0: "image_02"})
    # Latitudes are degrees of a sphere of 6,378 km: 1e-9 m. Poses of logs are float32.
    check_cameras(ahead, back, pairs)
    check_stamps(pairs, LATER)
    assert all(torch.equal(other.image, one.image) for one, other in pairs)
    assert [track.class_name for track in back.tracks] == [
        {"Vehicle": "Car"}.get(track.class_name, track.class_name) for track in ahead.tracks
    ]


def test_all_of_it_is_where_it_is_when_the_image_is_taken(ahead, back):
    times = times_of_frames(ahead)
    for one, other in zip(ahead.tracks, back.tracks, strict=True):
        wanted = [box_at(one, frame, times[frame]) for frame in one.frames.tolist()]
        poses = ahead.dataset_from_world @ torch.stack([pose for pose in wanted if pose is not None])
        torch.testing.assert_close(places(back, other), poses, rtol=0, atol=FLOAT32)
        assert other.frames.tolist() == one.frames.tolist()
        assert torch.allclose(other.size, one.size, rtol=1e-6)
    carried = 0
    for one, other in zip(ahead.sweeps.gray(), back.sweeps.gray(), strict=True):
        points = CarriedPoints(one.points, one.time, one.index, ahead.tracks).at(times[one.index])
        carried += int((points != one.points).any(1).sum())
        found = transform_points(back.dataset_from_world, other.points.double())
        wanted = transform_points(ahead.dataset_from_world, points.double())
        torch.testing.assert_close(found, wanted, rtol=0, atol=FLOAT32)
        assert other.stamp == round(1e9 * (0.1 * one.index + 0.02)) + LATER
    assert carried > 10


def test_masks_lie_beside_the_dates(ahead, root):
    back = KittiReader(root=root, drive=FIRST, masks=root / "masks").read()
    for one, other in matching(ahead, back, {0: "image_02"}):
        for kind in ("sky", "human", "vehicle"):
            assert torch.equal(getattr(other, kind), getattr(one, kind))
    assert not any(file.path.startswith("masks") for file in KittiWriter(masks=False).files(ahead))


def test_what_is_lost_of_a_street(log):
    boxes = sum(len(track.frames) for track in log.tracks)
    assert WRITER.losses(log) == (
        "all stamps are 2 s later: the layout has none before 0",
        "1 cameras get names of the layout: 0 is image_02",
        "2 cameras are lost, which do not look as the first one does, or are too many: 1, 2",
        f"{boxes} boxes are moved to the instants of the layout, up to 20 ms away from their own",
        "1 classes get names of the layout: Vehicle is Car",
        "the body poses of 1 objects are lost",
    )


def test_a_drive_is_as_it_was(planned, tmp_path):
    assert WRITER.losses(planned) == ()
    root = written(WRITER, planned, tmp_path)
    reader = KittiReader(root=root, drive=DRIVE)
    back = reader.read()
    pairs = matching(planned, back, dict(enumerate(planned.camera_names)))
    check_cameras(planned, back, pairs)
    check_stamps(pairs)
    assert all(torch.equal(other.image, one.image) for one, other in pairs)
    check_points(planned, back)
    check_boxes(planned, back, {})
    assert (back.name, back.camera_names) == (planned.name, planned.camera_names)
    assert [track.class_name for track in back.tracks] == ["Car", "Pedestrian"]
    assert reader.check() == []


def test_a_world_that_no_latitude_gives_is_moved(ahead, tmp_path):
    """UTM's coordinates of Karlsruhe: no place lies 5,430 km north of the equator in a plane of its own latitude."""
    far = torch.eye(4, dtype=torch.float64)
    far[:3, 3] = torch.tensor([456_000.0, 5_430_000.0, 115.0], dtype=torch.float64)
    distant = replace(ahead, dataset_from_world=far)
    (lost,) = (loss for loss in WRITER.losses(distant) if loss.startswith("the world is moved"))
    back = KittiReader(root=written(WRITER, distant, tmp_path), drive=FIRST).read()
    moved = torch.tensor([float(number) for number in lost.split(" by ")[1].split(" m:")[0].split(", ")])
    gap = places(back, back.tracks[0])[0, :3, 3] - places(ahead, ahead.tracks[0])[0, :3, 3]
    # The sentence has millimeters; the box moves on between its own instant and the image's.
    step = (far - ahead.dataset_from_world)[:3, 3] + moved.double()
    assert (gap - step).norm() < 0.5
    assert back.frames[0].camera.position.norm() < 1e-6


@pytest.mark.parametrize("latitude", [-33.9, 0.0, 0.01, 49.0, 56.4])
def test_a_place_has_the_latitude_of_its_own_plane(latitude, tmp_path):
    """By the closed form r cos(p) artanh(sin(p)), and by what a reader makes of it."""
    sine, cosine = np.sin(np.radians(latitude)), np.cos(np.radians(latitude))
    place = np.array([6378137.0 * cosine * np.radians(8.4), 6378137.0 * cosine * np.arctanh(sine), 115.0])
    plane = Mercator.through(place)
    assert plane is not None
    # Near the farthest latitude a nanometer is 1e-6 degrees.
    assert plane.latitude == pytest.approx(latitude, abs=1e-5)
    numbers = [plane.latitude, plane.longitude(place[0]), place[2], *[0.0] * 27]
    (tmp_path / "0.txt").write_text(" ".join(map(repr, map(float, numbers))))
    oxts = read_oxts(tmp_path / "0.txt")
    assert np.abs(oxts.world_from_imu(oxts.mercator_scale)[:3, 3].numpy() - place).max() < 2e-8
    north = plane.latitude_of(place[1] + 1000.0)
    (tmp_path / "1.txt").write_text(" ".join(map(repr, map(float, [north, *numbers[1:]]))))
    later = read_oxts(tmp_path / "1.txt").world_from_imu(oxts.mercator_scale)[1, 3]
    assert float(later) == pytest.approx(place[1] + 1000.0, abs=2e-8)


@pytest.mark.parametrize("place", [(0, 4.3e6, 0), (0, 0, 9500), (0, 0, -200), (2.1e7, 0, 0)])
def test_some_places_have_none(place):
    assert Mercator.through(np.array(place, float)) is None


def test_without_lidar_images_tell_the_instants(ahead, tmp_path):
    root = written(WRITER, replace(ahead, sweeps=Sweeps.of(())), tmp_path)
    assert not list(root.glob("*/*/velodyne_points"))
    back = KittiReader(root=root, drive=FIRST).read()
    check_stamps(matching(ahead, back, {0: "image_02"}), LATER)


def test_a_log_without_a_clock_and_cameras_beside_each_other(tmp_path):
    """Five cameras 1 m apart in a row: four are written, two of them as those that were gray."""
    log = make_log(num_frames=2, num_cameras=5)
    losses = WRITER.losses(log)
    assert losses[0].startswith("the log has no clock")
    assert losses[1] == (
        "4 cameras get names of the layout: 0 is image_02, 1 is image_03, 2 is image_00, 3 is image_01"
    )
    assert losses[2].endswith("too many: 4")
    root = written(WRITER, log, tmp_path)
    names = ["image_02", "image_03", "image_00", "image_01"]
    back = KittiReader(root=root, drive=FIRST, cameras=names).read()
    assert [frame.image[0, 0, 0].item() for frame in back.frames] == [0, 1, 2, 3, 10, 11, 12, 13]
    assert back.stamps == {0: 1_000_000_000, 1: 1_100_000_000}
    kept = replace(log, frames=log.frames.where(lambda view: view.camera_index < 4))
    check_cameras(kept, back, matching(kept, back, dict(enumerate(names))))


def with_frame(log: DrivingLog, place: int, frame: Frame | None) -> DrivingLog:
    frames = list(log.frames)
    return replace(log, frames=as_frames([*frames[:place], *([] if frame is None else [frame]), *frames[place + 1 :]]))


def test_an_image_apart_from_the_rig_is_told(planned):
    one = planned.frames[3]
    aside = one.camera.camera_from_world.clone()
    aside[0, 3] += 0.04
    losses = WRITER.losses(with_frame(planned, 3, replace(one, camera=replace(one.camera, camera_from_world=aside))))
    # Its camera's mean place over four frames goes a quarter of the way.
    assert losses == ("images are up to 0.03 m and 0 degrees from where one rig on one car has them",)


def test_an_image_that_is_absent_is_an_error(planned):
    with pytest.raises(ValueError, match="1 are absent, the first of camera 1 at frame 1: leave such frames"):
        list(WRITER.files(with_frame(planned, 3, None)))


def test_a_box_that_readers_refuse_is_an_error(ahead):
    track = ahead.tracks[0]
    poses = track.world_from_object.clone()
    poses[0, 0, 3] += 2000
    with pytest.raises(ValueError, match=f"object {track.name} at frame 0 lies 1... m from the lidar"):
        list(WRITER.files(replace(ahead, tracks=(replace(track, world_from_object=poses),))))


def test_a_car_that_readers_refuse_is_an_error(ahead):
    far = ahead.frames[2].camera.camera_from_world.clone()
    far[2, 3] -= 100
    fast = with_frame(ahead, 2, replace(ahead.frames[2], camera=replace(ahead.frames[2].camera, camera_from_world=far)))
    with pytest.raises(ValueError, match="around frame 1 the car of 'street_to_write' drives 517 m/s"):
        list(WRITER.files(fast))


def test_a_lens_is_taken_out(ahead, tmp_path):
    bent = with_cameras(ahead, distortion=torch.tensor([0.2, 0.05, 0.001, -0.002, 0.0]))
    assert any(loss.startswith("the lenses of 1 cameras, which move pixels") for loss in WRITER.losses(bent))
    root = written(WRITER, bent, tmp_path)
    back = KittiReader(root=root, drive=FIRST, masks=root / "masks").read()
    assert not torch.equal(back.frames[0].image, bent.frames[0].image)
    assert back.frames[0].ego is not None


def test_returns_near_the_lidar_are_counted(ahead):
    (sweep, *others) = ahead.sweeps
    near = replace(sweep, points=sweep.points.clone())
    near.points[:7] = ahead.frames[0].camera.position
    total = sum(len(one.points) for one in ahead.sweeps)
    losses = WRITER.losses(replace(ahead, sweeps=Sweeps.of((near, *others))))
    assert losses[-1].startswith(f"7 of {total} returns lie within 2.5 m of where the lidar is put")


def test_gaps_of_an_object_stay_gaps(ahead, tmp_path):
    track = ahead.tracks[0]
    assert track.times is not None
    rows = [0, 2]
    gappy = replace(
        track, frames=track.frames[rows], world_from_object=track.world_from_object[rows], times=track.times[rows],
        class_name="animal", body=None,
    )  # fmt: skip
    log = replace(ahead, tracks=(gappy,))
    back = KittiReader(root=written(WRITER, log, tmp_path), drive=FIRST).read()
    assert (back.tracks[0].frames.tolist(), back.tracks[0].class_name) == ([0, 2], "Misc")
    assert "1 boxes are left out, whose place nobody gave (state 0)" in back.notes
