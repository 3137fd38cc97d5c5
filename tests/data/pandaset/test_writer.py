"""Logs that are written as sequences of PandaSet, and read again."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.pandaset import PandaSetReader, PandaSetWriter
from sparsestreet.data.pandaset.frames import read_columns
from sparsestreet.data.pandaset.layout import CAMERA_FROM_LIDAR
from sparsestreet.data.pandaset.pickled import pickled_table
from sparsestreet.data.pandaset.spin import spin_of
from sparsestreet.geometry.boxes import CarriedPoints, box_at
from sparsestreet.geometry.cameras import inverse, transform_points
from tests.data.pandaset.write import CAMERAS, PandaPlan, write_sequence
from tests.data.round_trip import (
    FLOAT32,
    camera_pose,
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

WRITER = PandaSetWriter()
NAMES = {0: "front_camera", 1: "front_left_camera", 2: "front_right_camera"}


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> DrivingLog:
    """The front camera fires 20 ms behind the sweeps and boxes."""
    return street(tmp_path_factory)


@pytest.fixture(scope="module")
def root(log, tmp_path_factory) -> Path:
    return written(WRITER, log, tmp_path_factory.mktemp("pandaset") / "street")


@pytest.fixture(scope="module")
def back(root) -> DrivingLog:
    return PandaSetReader(root=root).read()


def test_images_of_a_street_have_their_own_poses_and_stamps(log, back):
    pairs = matching(log, back, NAMES)
    check_cameras(log, back, pairs)
    check_stamps(pairs)
    for one, other in pairs:
        # Edges of one pixel in 8 x 8 blocks, at quality 95.
        assert (other.image.int() - one.image.int()).abs().float().mean() < 3


def test_objects_and_points_are_where_they_are_when_the_front_camera_fires(log, back):
    times = {view.indices[0]: view.time for view in log.views if view.indices[1] == 0}
    found = {track.name: track for track in back.tracks}
    for one in log.tracks:
        other = found.pop(one.name)
        wanted = [box_at(one, frame, times[frame]) for frame in one.frames.tolist()]
        poses = log.dataset_from_world @ torch.stack([pose for pose in wanted if pose is not None])
        torch.testing.assert_close(places(back, other), poses, rtol=0, atol=FLOAT32)
        assert other.frames.tolist() == one.frames.tolist()
        assert torch.allclose(other.size, one.size, rtol=1e-6)  # float32
        assert other.class_name == {"Vehicle": "Car", "Cyclist": "Bicycle"}.get(one.class_name, one.class_name)
    assert not found
    for one, other in zip(log.sweeps.gray(), back.sweeps.gray(), strict=True):
        points = CarriedPoints(one.points, one.time, one.index, log.tracks).at(times[one.index])
        assert (points != one.points).any()
        wanted = transform_points(log.dataset_from_world, points.double())
        found_points = transform_points(back.dataset_from_world, other.points.double())
        torch.testing.assert_close(found_points, wanted, rtol=0, atol=FLOAT32)
        assert other.stamp == 100_000_000 * one.index + 20_000_000


def test_masks_lie_beside_it(log, root):
    back = PandaSetReader(root=root, masks=root / "masks").read()
    for one, other in matching(log, back, NAMES):
        for kind in ("sky", "human", "vehicle"):
            assert torch.equal(getattr(other, kind), getattr(one, kind))
    assert not any(file.path.startswith("masks") for file in PandaSetWriter(masks=False).files(log))


def test_what_is_lost_of_a_street(log):
    boxes = sum(len(track.frames) for track in log.tracks)
    assert WRITER.losses(log) == (
        "3 cameras get names of the layout: 0 is front_camera, 1 is front_left_camera, 2 is front_right_camera",
        f"{boxes} boxes are moved to the instants of the layout, up to 20 ms away from their own",
        "2 classes get names of the layout: Cyclist is Bicycle, Vehicle is Car",
        "the body poses of 1 objects are lost",
    )


def test_a_sequence_is_as_it_was(tmp_path):
    """The front camera fires at the middle of the sweep. A box has the stamp at which the beam passed it, and is moved
    to that of the image; the second object stands."""
    log = PandaSetReader(root=write_sequence(tmp_path / "first"), cameras=list(CAMERAS)).read()
    (lost,) = WRITER.losses(log)
    assert lost.startswith("8 boxes are moved to the instants of the layout")
    root = written(WRITER, log, tmp_path / "second")
    reader = PandaSetReader(root=root, cameras=list(CAMERAS))
    back = reader.read()
    pairs = matching(log, back, dict(enumerate(log.camera_names)))
    check_cameras(log, back, pairs)
    check_stamps(pairs)
    check_points(log, back)
    plan = PandaPlan()
    car, parked = log.tracks
    check_boxes(replace(log, tracks=(replace(parked, times=None),)), replace(back, tracks=back.tracks[1:]), {})
    # The plan's car turns at 0.1 rad/s, and goes straight between two boxes here: 8 m/s^2 / 80 x 0.05^2 s^2.
    gap = places(back, back.tracks[0]) - torch.from_numpy(plan.world_from_box(plan.stamps))
    assert gap[1:3].abs().max() < 5e-3
    assert (back.name, [track.class_name for track in back.tracks]) == ("001", ["Car", "Pickup Truck"])
    assert (car.name, parked.name) == (back.tracks[0].name, back.tracks[1].name)
    assert "1 of 2 objects are marked as standing all the time" in back.notes
    assert reader.check() == []


def test_nanoseconds_and_times_before_zero_are_kept(log, tmp_path):
    frames = [replace(frame, stamp=(frame.stamp or 0) + 7) for frame in log.frames]
    late = replace(log, frames=as_frames(frames), sweeps=Sweeps.of(()), tracks=())
    back = PandaSetReader(root=written(WRITER, late, tmp_path)).read()
    assert back.stamps[0] == -29_999_993
    check_stamps(matching(late, back, NAMES))
    assert len(back.sweeps) == 0
    assert not (tmp_path / "001/annotations").exists()


def test_the_kit_of_pandaset_finds_the_lidar_where_the_points_are_seen_from(log, root):
    poses = json.loads((root / "001/lidar/poses.json").read_text())
    wanted = camera_pose(log, log.views[0]) @ CAMERA_FROM_LIDAR
    assert [poses[0]["position"][axis] for axis in "xyz"] == pytest.approx(wanted[:3, 3].tolist(), abs=FLOAT32)


def test_a_box_that_leans_is_told(log):
    track = log.tracks[0]
    poses = track.world_from_object.clone()
    c, s = np.cos(np.radians(3)), np.sin(np.radians(3))
    poses[:, :3, :3] = poses[:, :3, :3] @ torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]])
    losses = WRITER.losses(replace(log, tracks=(replace(track, world_from_object=poses),)))
    assert "boxes stand upright, while the log's lean by up to 3 degrees" in losses


def test_a_frame_without_boxes_and_a_frame_without_a_sweep(log, tmp_path):
    track = log.tracks[0]
    assert track.times is not None
    first = replace(
        track, frames=track.frames[:1], world_from_object=track.world_from_object[:1], times=track.times[:1]
    )
    sparse = replace(log, tracks=(first,), sweeps=Sweeps.of((log.sweeps[0], log.sweeps[2])))
    back = PandaSetReader(root=written(WRITER, sparse, tmp_path)).read()
    assert [track.frames.tolist() for track in back.tracks] == [[0]]
    assert [len(sweep.points) > 0 for sweep in back.sweeps.gray()] == [True, False, True]


def test_a_log_without_a_clock(tmp_path):
    log = make_log(num_frames=2)
    assert WRITER.losses(log)[0].startswith("the log has no clock")
    root = written(WRITER, log, tmp_path)
    assert PandaSetReader(root=root).read().stamps == {0: 1_000_000_000, 1: 1_100_000_000}


def test_an_image_that_is_absent_is_an_error(log):
    frames = [frame for frame in log.frames if frame.indices != (1, 2)]
    with pytest.raises(ValueError, match="1 are absent, the first of camera 2 at frame 1: leave such frames"):
        list(WRITER.files(replace(log, frames=as_frames(frames))))


def test_a_sequence_without_its_front_camera_is_an_error(log):
    aside = replace(log, camera_names=("left_camera", "right_camera", "back_camera"))
    with pytest.raises(ValueError, match="PandaSet needs its front_camera, the log has left_camera"):
        list(WRITER.files(aside))


def test_a_lens_is_taken_out(log, tmp_path):
    bent = with_cameras(log, distortion=torch.tensor([0.2, 0.05, 0.001, -0.002, 0.0]))
    assert any(loss.startswith("the lenses of 3 cameras, which move pixels") for loss in WRITER.losses(bent))
    root = written(WRITER, bent, tmp_path)
    back = PandaSetReader(root=root, masks=root / "masks").read()
    plain, straight = bent.frames[0].image.int(), back.frames[0].image.int()
    assert (plain - straight).abs().float().mean() > 3
    assert back.frames[0].ego is not None


def test_returns_near_the_lidar_are_counted(log):
    (sweep, *others) = log.sweeps
    near = replace(sweep, points=sweep.points.clone())
    near.points[:7] = inverse(log.frames[0].camera.camera_from_world)[:3, 3]
    losses = WRITER.losses(replace(log, sweeps=Sweeps.of((near, *others))))
    total = sum(len(one.points) for one in log.sweeps)
    assert any(loss.startswith(f"7 of {total} returns lie within 1 x 2 x 2 m") for loss in losses)


COLUMNS = {
    "x": np.array([0.5, -1e300, np.pi]),
    "uuid": ["a", "", "é"],
    "n": np.array([3, -(2**62), 0]),
    "y": np.array([1.0, 2.0, 3.0]),
    "flag": np.array([True, False, True]),
}
KINDS = {"x": float, "uuid": str, "n": int, "y": float, "flag": bool}


def test_tables_have_what_was_put_into_them(tmp_path):
    (tmp_path / "00.pkl").write_bytes(pickled_table(COLUMNS))
    found = read_columns(tmp_path / "00.pkl", KINDS)
    for name, values in COLUMNS.items():
        np.testing.assert_array_equal(found[name], np.array(values, found[name].dtype))
    assert pickled_table(COLUMNS) == pickled_table(COLUMNS)


def test_pandas_reads_them_too(tmp_path, root):
    pandas = pytest.importorskip("pandas")
    (tmp_path / "00.pkl").write_bytes(pickled_table(COLUMNS))
    theirs = pandas.read_pickle(tmp_path / "00.pkl")
    assert list(theirs.columns) == list(COLUMNS)
    for name, values in COLUMNS.items():
        np.testing.assert_array_equal(theirs[name].to_numpy(), np.array(values, theirs[name].dtype))
    assert len(pandas.read_pickle(root / "001/lidar/00.pkl.gz").query("d == 0")) > 1000
    assert (pandas.read_pickle(root / "001/annotations/cuboids/00.pkl.gz")["dimensions.y"] > 0.4).all()


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
    losses = WRITER.losses(replace(log, frames=as_frames(turned)))
    assert "readers take the lowest rows of back_camera for the recording car's" in losses


def test_points_of_one_instant_show_no_turn():
    """However narrow what the lidar sees: here 30 degrees ahead."""
    azimuths = np.linspace(-0.25, 0.25, 100)
    assert spin_of(azimuths, np.zeros(100), 0.1) is None
    assert spin_of(azimuths, azimuths / (2 * np.pi) * 0.1, 0.1) is not None
