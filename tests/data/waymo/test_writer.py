"""A log that is written as a segment is read as it was, and what cannot be is said."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import get_class
from omegaconf import OmegaConf
from scipy.spatial import KDTree

from sparsestreet.data.convert import Source, convert
from sparsestreet.data.drivestudio import DriveStudioWriter
from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic import StreetReader, make_street
from sparsestreet.data.waymo import WaymoReader
from sparsestreet.data.waymo.v1.writer import WaymoV1Writer
from sparsestreet.data.waymo.v2.writer import WaymoV2Writer
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.boxes import box_at
from sparsestreet.types import Shutter, Sweep, Track
from tests.conftest import unchecked
from tests.data.round_trip import STREET, check_boxes, check_cameras, written
from tests.data.round_trip import street as delayed_street
from tests.data.streets import make_log
from tests.data.waymo import records
from tests.data.waymo.drive import Drive
from tests.shared import made_once
from tests.typed import there

WRITERS = {1: WaymoV1Writer, 2: WaymoV2Writer}
CLOCK = 480
"""Nanoseconds: the middle of two doubles of 1.5e9 seconds, read twice."""


@pytest.fixture(autouse=True, scope="module")
def _checks() -> Iterator[None]:
    """The parts have tests of their own, with checks of shapes."""
    with unchecked():
        yield


@pytest.fixture(params=[1, 2])
def writer(request):
    if request.param == 2:
        pytest.importorskip("pyarrow", reason="version 2 needs pyarrow")
    return WRITERS[request.param](jpeg_quality=None)


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> DrivingLog:
    """All sensors at one instant: its lidar stands where the first camera says."""
    settings = replace(STREET, delays=())
    return StreetReader(settings, made_once(tmp_path_factory, "street", partial(make_street, settings))).read()


@pytest.fixture(scope="module")
def recorded(roots) -> DrivingLog:
    """The planned drive, which the tests' own writer wrote: rolling shutters, lenses, images of their own instants."""
    return WaymoReader(root=roots[1]).read()


def test_a_street_comes_back(street, writer, tmp_path):
    reader = WaymoReader(root=written(writer, street, tmp_path))
    assert reader.check() == []
    read = reader.read()
    # The inverse of a float32 matrix, twice.
    assert_same_views(street, read, place=1e-6)
    assert_same_pixels(street, read, ("sky", "human", "vehicle"))
    # Its beams and steps are found: float32 of points up to 100 m from the origin is left, 8e-6 m an axis, twice.
    assert distances_of_points(street, read).max() < 5e-5
    read_tracks = by_name(read)
    assert read_tracks.keys() == by_name(street).keys()
    for track in street.tracks:
        other = read_tracks[track.name]
        assert (other.class_name, other.frames.tolist()) == (track.class_name, track.frames.tolist())
        torch.testing.assert_close(other.world_from_object, track.world_from_object, rtol=0, atol=1e-6)
        torch.testing.assert_close(other.size, track.size, rtol=1e-6, atol=0)
        torch.testing.assert_close(there(other.times), there(track.times), rtol=0, atol=1e-9)


def test_a_street_whose_cameras_fire_one_after_the_other(tmp_path_factory, tmp_path):
    """Returns are at the frame's stamp, where the vehicle is between its images."""
    log = delayed_street(tmp_path_factory)
    read = WaymoReader(root=written(WaymoV1Writer(jpeg_quality=None), log, tmp_path)).read()
    # 30 ms before 0 is not to be had.
    assert [view.stamp for view in read.views] == [there(view.stamp) + 1_000_000_000 for view in log.views]
    check_cameras(log, read, list(zip(log.frames, read.frames, strict=True)))
    distances = distances_of_points(log, read, later=1_000_000_000)
    # The car's speed changes by less than a hundredth in 0.1 s, of 1.5 m: the lidar's place is a few millimeters off.
    assert distances.max() < 5e-3
    check_boxes(log, read, {})


def test_a_recorded_drive_comes_back(recorded, writer, tmp_path):
    """Shutters, lenses, stamps of their own, a world 4 km from its origin."""
    root = written(replace(writer, rows=64, columns=1024), recorded, tmp_path)
    read = WaymoReader(root=root).read()
    # What the car drives in the clock's error, and float32.
    assert_same_views(recorded, read, place=6e-6, clock=CLOCK)
    assert_same_pixels(recorded, read, ("sky", "human", "vehicle"))
    assert read.name == recorded.name
    for one, other in zip(recorded.views, read.views, strict=True):
        assert torch.equal(there(one.camera.distortion), there(other.camera.distortion))
        mine, theirs = there(one.camera.shutter), there(other.camera.shutter)
        assert mine.direction == theirs.direction
        # Ends of the readout in doubles of seconds are 240 ns off, of 44 ms, in which the car drives 0.44 m.
        torch.testing.assert_close(theirs.translation, mine.translation, rtol=0, atol=6e-6)
        torch.testing.assert_close(theirs.rotation, mine.rotation, rtol=0, atol=1e-7)
    # Half a step of columns, and of rows if they are even, from each point, up to 45 m away.
    low, high = there(writer.segment(recorded).lidar).limits
    assert distances_of_points(recorded, read).max() < 45 * np.hypot(np.pi / 1024, (high - low) / 128)
    for one, other in zip(recorded.tracks, read.tracks, strict=True):
        assert (one.class_name, one.frames.tolist()) == (other.class_name, other.frames.tolist())
        span = there(recorded.views[-1].stamp) - there(recorded.views[0].stamp)
        assert float((there(one.times) - there(other.times)).abs().max()) * span < 1000
        torch.testing.assert_close(
            other.world_from_object[:, :3, 3], one.world_from_object[:, :3, 3], rtol=0, atol=1e-5
        )
        # Box and vehicle lean by the same 0.03, in headings that differ by up to 0.12; the mean of both is the upright.
        torch.testing.assert_close(other.world_from_object, one.world_from_object, rtol=0, atol=5e-4)


def test_a_box_of_another_instant_is_where_the_object_was_when_the_beam_crossed_it(tmp_path):
    """Between its boxes, and beyond them at constant velocity."""
    records.write_drive(tmp_path / "lidar", Drive(synced=False))
    log = WaymoReader(root=tmp_path / "lidar").read()
    # 4 ms later than the beam, and farther from any image.
    log = replace(log, tracks=(replace(log.tracks[0], times=there(log.tracks[0].times) + 0.01),))
    read = WaymoReader(root=written(WaymoV1Writer(rows=8, columns=8), log, tmp_path / "written")).read()
    (one,), (other,) = log.tracks, read.tracks
    first = there(log.views[0].stamp) - log.views[0].time * (span := _span(log))
    again = there(read.views[0].stamp) - read.views[0].time * _span(read)
    stamps = [again + float(time) * _span(read) for time in there(other.times)]
    assert (
        max(abs(stamp - first - float(time) * span) for stamp, time in zip(stamps, there(one.times), strict=True)) > 1e6
    )
    for place, stamp in enumerate(stamps):
        expected = there(box_at(one, int(one.frames[place]), (stamp - first) / span))
        torch.testing.assert_close(other.world_from_object[place, :3, 3], expected[:3, 3], rtol=0, atol=1e-5)
    (said,) = [loss for loss in WaymoV1Writer().losses(log) if "boxes are carried" in loss]
    assert said.startswith("4 of 4 boxes are carried along their tracks to another instant, by up to ")


def _span(log: DrivingLog) -> float:
    first, last = log.views[0], log.views[-1]
    return (there(last.stamp) - there(first.stamp)) / (last.time - first.time)


def test_what_is_lost_is_said(street):
    losses = WaymoV1Writer().losses(street)
    assert len(losses) == 4
    said = " | ".join(losses)
    assert "3 cameras get names of the layout: 0 is FRONT, 1 is FRONT_LEFT" in said
    assert "images become JPEG of quality 95" in said
    assert "the body poses of 1 objects are lost" in said
    number = sum(len(sweep.points) for sweep in street.sweeps.gray())
    rays = "find no place in range images of 16 x 120 rays, two a ray"
    assert f"0 of {number} returns {rays}; the others move by 0.00" in said


def test_what_is_lost_of_a_recorded_drive_is_said(recorded):
    said = " | ".join(WaymoV1Writer(jpeg_quality=None).losses(recorded))
    assert "images by up to 1 ns" in said
    assert "44 ms is said" in said
    assert "boxes lean by up to 0.01 degrees" in said or "boxes lean by up to 0.0098 degrees" in said
    # float32 has steps of 0.49 mm at 4,123 m, and rounds by half of one.
    assert "poses of pixels are float32: 0.24 mm" in said
    assert "of 1591 returns find no place in range images of 256 x 4096 rays" in said
    assert "boxes are carried" not in said


def test_classes_without_a_counterpart_are_left_out(street, tmp_path):
    names = ["bus", "Animals - Other", "rider", *(track.class_name for track in street.tracks[3:])]
    tracks = tuple(replace(one, class_name=name) for one, name in zip(street.tracks, names, strict=True))
    log = replace(street, tracks=tracks)
    said = " | ".join(WaymoV1Writer().losses(log))
    assert "1 objects of Animals - Other are left out" in said
    assert "2 classes get names of the layout: bus is Vehicle, rider is Cyclist" in said
    read = by_name(WaymoReader(root=written(WaymoV1Writer(), log, tmp_path), lidar=False).read())
    assert read.keys() == by_name(street).keys() - {tracks[1].name}
    assert (read[tracks[0].name].class_name, read[tracks[2].name].class_name) == ("Vehicle", "Cyclist")


def test_a_log_without_clock_lidar_and_boxes(writer, tmp_path):
    log = make_log(num_frames=3)
    read = WaymoReader(root=written(writer, log, tmp_path)).read()
    assert [view.stamp for view in read.views[::2]] == [1_000_000_000, 1_100_000_000, 1_200_000_000]
    # Without a clock times are frame / (frames - 1), which is the same.
    assert [view.time for view in read.views] == pytest.approx([view.time for view in log.views])
    assert (len(read.sweeps), read.tracks) == (0, ())
    assert torch.equal(read.frames[3].image, log.frames[3].image)
    assert "the log has no clock: its frames get stamps 0.1 s apart, from 1 s on" in writer.losses(log)


def test_stamps_before_zero_are_moved_by_whole_seconds(street, tmp_path):
    views = [replace(frame, stamp=there(frame.stamp) - 2_050_000_000) for frame in street.frames]
    sweeps = tuple(replace(sweep, stamp=there(sweep.stamp) - 2_050_000_000) for sweep in street.sweeps)
    log = replace(street, frames=as_frames(views), sweeps=Sweeps.of(sweeps))
    read = WaymoReader(root=written(WaymoV1Writer(), log, tmp_path)).read()
    assert [view.stamp for view in read.views[::3]] == [950_000_000, 1_050_000_000, 1_150_000_000]
    assert [sweep.stamp for sweep in read.sweeps] == [950_000_000, 1_050_000_000, 1_150_000_000]
    assert "all stamps are 3 s later" in " | ".join(WaymoV1Writer().losses(log))


def test_a_third_return_of_a_ray_is_lost(street, tmp_path):
    """The nearest two stay."""
    first = street.sweeps[0]
    lidar = street.dataset_from_world[:3, 3].new_tensor([-0.7, 0.0, 0.25])  # the street's own mounts
    behind = lidar + (first.points.double() - lidar) * torch.tensor([1.01, 1.02]).double()[:, None, None]
    points = torch.cat((first.points, *behind.float()))
    twin = Sweep(0, first.time, points, torch.zeros_like(points), torch.zeros(len(points)).bool(), stamp=first.stamp)
    log = replace(street, sweeps=Sweeps.of((twin,)))
    (said,) = [loss for loss in WaymoV1Writer().losses(log) if "find no place" in loss]
    assert said.startswith(f"{len(first.points)} of {3 * len(first.points)} returns find no place")
    read = WaymoReader(root=written(WaymoV1Writer(), log, tmp_path)).read()
    kept = torch.cat((first.points, behind[0].float()))
    assert len(read.sweeps[0].points) == len(kept)
    torch.testing.assert_close(read.sweeps[0].points.double().sum(0), kept.double().sum(0), rtol=0, atol=0.1)


def test_logs_that_no_segment_can_hold(street):
    with pytest.raises(ValueError, match="has 6 cameras, a segment of Waymo's has 5: choose that many"):
        list(WaymoV1Writer().losses(make_log(num_cameras=6)))
    frames = list(street.frames)
    frames[4] = replace(frames[4], camera=replace(frames[4].camera, intrinsics=frames[4].camera.intrinsics * 2))
    with pytest.raises(ValueError, match="camera 1 of 'street' has images of other sizes, lenses or shutters"):
        WaymoV1Writer().losses(replace(street, frames=as_frames(frames)))


@pytest.mark.parametrize("direction", ["top", "left", "bottom", "right"])
def test_shutters_of_all_sides(direction, tmp_path):
    log = make_log(num_frames=2)
    shutter = Shutter(torch.tensor([0.1, 0.2, -0.3]), torch.tensor([0.01, -0.02, 0.03]), direction)
    frames = [replace(one, camera=replace(one.camera, shutter=shutter)) for one in log.frames]
    log = replace(log, frames=as_frames(frames))
    for view in WaymoReader(root=written(WaymoV1Writer(), log, tmp_path)).read().views:
        read = there(view.camera.shutter)
        assert read.direction == direction
        # Linear velocities are float32.
        torch.testing.assert_close(read.translation, shutter.translation, rtol=0, atol=1e-6)
        torch.testing.assert_close(read.rotation, shutter.rotation, rtol=0, atol=1e-7)


def test_bytes_are_equal_whenever_they_are_asked_and_come_in_parts(street, writer):
    files = {file.path: file for file in writer.files(street)}
    for file in files.values():
        parts = list(file.content())
        assert b"".join(parts) == b"".join(file.content())
    images = next(file for path, file in files.items() if "camera_image" in path or path.endswith("tfrecord"))
    # A part or more for each of three frames; none holds two.
    parts = [len(part) for part in images.content()]
    assert len(parts) > 3
    assert max(parts) < sum(parts) / 2


def test_a_turned_world_is_the_data_set_s_own(street, tmp_path):
    """Not only moved from the log's: turned too."""
    turned = torch.eye(4, dtype=torch.float64)
    turned[:3, :3] = quat.to_matrix(quat.from_rotation_vector(torch.tensor([0.2, -0.1, 0.7], dtype=torch.float64)))
    turned[:3, 3] = torch.tensor([10.0, -20.0, 5.0], dtype=torch.float64)
    log = replace(street, dataset_from_world=turned)
    recording = WaymoReader(root=written(WaymoV1Writer(), log, tmp_path)).recording()
    from_world = log.views[4].camera.camera_from_world.double()
    shot = recording.shots[4]
    torch.testing.assert_close(shot.world_from_camera @ from_world, turned, rtol=0, atol=1e-5)
    points = log.sweeps[1].points.double() @ turned[:3, :3].T + turned[:3, 3]
    there_points = there(recording.sweeps)[1].read()
    torch.testing.assert_close(there_points.sum(0), points.sum(0), rtol=0, atol=0.05)


def assert_same_views(log: DrivingLog, read: DrivingLog, *, place: float, clock: int = 0) -> None:
    """Cameras to ``place`` (an entry of a matrix, meters), stamps to ``clock`` nanoseconds."""
    assert [view.indices for view in log.views] == [view.indices for view in read.views]
    for one, other in zip(log.views, read.views, strict=True):
        torch.testing.assert_close(one.camera.intrinsics, other.camera.intrinsics, rtol=1e-6, atol=0)
        assert (one.camera.width, one.camera.height) == (other.camera.width, other.camera.height)
        torch.testing.assert_close(one.camera.camera_from_world, other.camera.camera_from_world, rtol=0, atol=place)
        assert abs(there(one.stamp) - there(other.stamp)) <= clock


def assert_same_pixels(log: DrivingLog, read: DrivingLog, kinds: Sequence[str]) -> None:
    for one, other in zip(log.frames, read.frames, strict=True):
        assert torch.equal(one.image, other.image)
        for kind in kinds:
            masks = getattr(one, kind), getattr(other, kind)
            assert (masks[0] is None) == (masks[1] is None)
            assert masks[0] is None or torch.equal(*masks)


def distances_of_points(log: DrivingLog, read: DrivingLog, later: int = 0) -> np.ndarray:
    """Meters from each point to the nearest one of the other log's sweep, of sweeps of equal stamps and numbers."""
    found = []
    for one, other in zip(log.sweeps, read.sweeps, strict=True):
        assert (one.index, there(one.stamp) + later, len(one.points)) == (other.index, other.stamp, len(other.points))
        found += [KDTree(other.points).query(one.points)[0], KDTree(one.points).query(other.points)[0]]
    return np.concatenate(found)


def by_name(log: DrivingLog) -> dict[str, Track]:
    return {track.name: track for track in log.tracks}


@pytest.mark.parametrize("version", [1, 2])
def test_conf_layout_says_what_the_writer_takes_by_itself(version):
    path = Path(__file__).parents[3] / "conf" / "layout" / f"waymo_v{version}.yaml"
    config = OmegaConf.to_container(OmegaConf.load(path))
    assert isinstance(config, dict)
    writer = get_class(str(config.pop("_target_")))
    assert writer is WRITERS[version]
    own = {name: list(value) if isinstance(value, tuple) else value for name, value in vars(writer()).items()}
    assert config == own


def test_a_segment_becomes_drivestudios_flavor_of_waymo(roots, drive, tmp_path):
    """As its own preprocessing writes it: the vehicle's pose of the frame, and the calibrated mounts."""
    with unchecked():
        log = WaymoReader(root=roots[1]).read()
        convert(log, Source(log.name, "0" * 12), DriveStudioWriter(), tmp_path / "out")
    assert log.vehicle is not None
    poses = log.dataset_from_world @ log.vehicle.poses
    for frame in range(log.num_frames):
        found = np.loadtxt(tmp_path / f"out/ego_pose/{frame:03d}.txt")
        np.testing.assert_allclose(found, poses[frame].numpy(), rtol=0, atol=1e-6)
    for number, camera in enumerate(drive.cameras[:2]):
        mount = np.loadtxt(tmp_path / f"out/extrinsics/{number}.txt")
        # x ahead, as Waymo's cameras have it; the path is a chord of the curve between two frames.
        right = camera.vehicle_from_camera @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
        np.testing.assert_allclose(mount, right, rtol=0, atol=0.01)
    assert np.fromfile(tmp_path / "out/lidar/000.bin", np.float32).size % 14 == 0
