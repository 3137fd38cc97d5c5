"""From a log to scans, and from found objects to its tracks. The log is that of a car ahead, whose cameras fire after
the lidar; what is found is told by a stub."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.recording import LidarSweep
from sparsestreet.kept import Kept
from sparsestreet.tracking import street
from sparsestreet.tracking.objects import FoundObject, upright_poses
from sparsestreet.tracking.scans import Scan
from sparsestreet.tracking.settings import TrackingSettings
from sparsestreet.tracking.street import assumptions, found_tracks, joined, scans_of, tracks_of
from sparsestreet.types import Track
from tests.data.plan import Plan
from tests.data.test_recording import boxes, read, recording, sweep
from tests.typed import there

CLASSES: dict[str, str] = {"vehicle": "Car", "cyclist": "Cyclist", "pedestrian": "Pedestrian"}
PLAN = Plan()
LATE = tuple(int(stamp) + 40_000_000 + 5_000_000 * frame for frame, stamp in enumerate(PLAN.stamps))
"""Stamps of sweeps that are no frame's."""
STOOD = torch.tensor([3.0, -2.0, 1.5], dtype=torch.float64)


def late_log(**changes) -> DrivingLog:
    """A log whose sweeps have stamps of their own."""
    sweeps = {frame: LidarSweep(lambda frame=frame: sweep(frame), LATE[frame]) for frame in range(PLAN.num_frames)}
    return read(**{"sweeps": sweeps, "boxes": None} | changes)


def found_of(track: Track) -> FoundObject:
    """What a perfect search would find of an annotated object."""
    frames, count = track.frames.numpy(), len(track.frames)
    size = track.size.double().numpy()
    poses = track.world_from_object.numpy()
    return FoundObject("vehicle", frames, poses, size, np.full(3, 0.1), np.full(count, 9), 1.0)


def box(name: str, x: list[float], y: float = 0.0, yaw: float = 0.0, first: int = 0) -> Track:
    middle = np.stack((np.array(x), np.full(len(x), y), np.zeros(len(x))), 1)
    poses = torch.from_numpy(upright_poses(middle, np.full(len(x), yaw)))
    return Track(name, "Car", torch.arange(first, first + len(x)), poses, torch.tensor([4.0, 2.0, 1.5]))


def test_each_frame_is_a_scan_and_those_held_out_have_no_points():
    log = late_log()
    scans = scans_of(log, frozenset({2}))
    assert [scan.frame for scan in scans] == [0, 1, 2, 3]
    assert [len(scan.points) for scan in scans] == [0 if frame == 2 else len(sweep(frame)) for frame in range(4)]
    assert np.diff([scan.seconds for scan in scans]) == pytest.approx(0.105, abs=1e-9)  # of any zero
    near = sweep(1) - log.dataset_from_world[:3, 3]
    assert np.abs(scans[1].points - near.numpy()).max() < 1e-5  # float32 of 60 m


def test_where_the_lidar_stood_is_told_or_taken_to_be_amid_the_cameras():
    log = late_log()
    for scan in scans_of(log, frozenset()):
        cameras = [view.camera.position.double() for view in log.views if view.frame_index == scan.frame]
        assert np.allclose(scan.origin, torch.stack(cameras).mean(0).numpy(), atol=1e-12)
    assert [line for line in assumptions(log) if "amid the cameras" in line]
    origin = log.dataset_from_world[:3, 3]
    told = {
        frame: replace(one, origin=origin + STOOD) for frame, one in there(recording().sweeps).items() if frame != 3
    }
    log = read(sweeps=told)
    assert assumptions(log) == []
    scans = scans_of(log, frozenset({0}))
    assert [np.allclose(scan.origin, STOOD.numpy(), atol=1e-9) for scan in scans] == [False, True, True, False]
    assert [len(scan.points) > 0 for scan in scans] == [False, True, True, False]  # frame 3 has no sweep


@pytest.mark.parametrize("frames", [(0, 1, 2, 3), (1, 2)], ids=["all", "some"])
def test_found_boxes_are_timed_as_annotated_ones_of_the_same_instants(frames: tuple[int, ...]):
    log = late_log(boxes=[boxes(frames, tuple(LATE[frame] for frame in frames))])
    (annotated,) = log.tracks
    (found,) = tracks_of(log, [found_of(annotated)], CLASSES)
    torch.testing.assert_close(there(found.times), there(annotated.times), rtol=0, atol=1e-12)  # rounding of a line
    assert there(found.span) == pytest.approx(there(annotated.span), abs=1e-12)
    assert (found.name, found.class_name, found.found) == ("found_1", "Car", True)
    assert torch.equal(found.size, annotated.size)
    assert torch.equal(found.world_from_object, annotated.world_from_object)


def test_a_log_without_a_clock_has_ten_frames_a_second():
    shots = [replace(shot, stamp=None) for shot in recording().shots]
    log = read(frame_stamps=None, shots=shots, boxes=None)
    assert [scan.seconds for scan in scans_of(log, frozenset())] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert "no clock" in assumptions(log)[0]
    (found,) = tracks_of(log, [found_of(box("a", [0.0, 1.0, 2.0, 3.0]))], CLASSES)
    assert (found.times, found.span) == (None, None)


def test_found_boxes_carry_returns_as_annotated_ones_do():
    """Depth and colors come from where the car is when an image is taken, also in a split."""
    annotated = read()
    plain = read(boxes=None)
    tracks = tracks_of(plain, [found_of(annotated.tracks[0])], CLASSES)
    own = plain.with_tracks(tracks)
    assert not torch.equal(there(plain.frames[0].depth), there(own.frames[0].depth))
    assert (annotated.is_annotated, plain.is_annotated, own.is_annotated) == (True, False, False)
    split, own_split = (StreetData(log, stride=4, offset=2).driving_log for log in (annotated, own))
    for wanted, got in ((annotated, own), (split, own_split)):
        for one, other in zip(wanted.frames, got.frames, strict=True):
            torch.testing.assert_close(there(one.depth), there(other.depth), rtol=0, atol=1e-5)
        for one, other in zip(wanted.sweeps, got.sweeps, strict=True):
            assert torch.equal(one.colors, other.colors)
            assert torch.equal(one.colored, other.colored)


def test_without_tracks_returns_stay_where_they_were_measured():
    plain, bare = read(boxes=None), read().with_tracks(())
    assert bare.tracks == ()
    for one, other in zip(plain.frames, bare.frames, strict=True):
        assert torch.equal(there(one.depth), there(other.depth))


def test_the_search_sees_no_held_out_sweep_and_its_answer_is_kept(tmp_path, monkeypatch):
    asked: list[list[int]] = []

    def find(scans: list[Scan], settings: TrackingSettings, report) -> tuple[FoundObject, ...]:
        asked.append([scan.frame for scan in scans if len(scan.points)])
        return (found_of(read().tracks[0]),)

    monkeypatch.setattr(street, "find_objects", find)
    settings = TrackingSettings()
    log = replace(late_log(), kept=Kept(tmp_path, "a log"))
    first = found_tracks(log, settings, frozenset({1}), CLASSES)
    again = found_tracks(replace(log, kept=Kept(tmp_path, "a log")), settings, frozenset({1}), CLASSES)
    assert asked == [[0, 2, 3]]
    assert torch.equal(first[0].world_from_object, again[0].world_from_object)
    found_tracks(log, settings, frozenset(), CLASSES)
    found_tracks(log, replace(settings, min_moved=3.0), frozenset({1}), CLASSES)
    assert asked[1:] == [[0, 1, 2, 3], [0, 2, 3]]


def test_without_lidar_nothing_can_be_found():
    with pytest.raises(ValueError, match="tracks are found in lidar, and planned has none: read its lidar"):
        found_tracks(read(sweeps=None), TrackingSettings(), frozenset(), CLASSES)


def test_found_objects_join_annotated_ones_without_doubling():
    known = box("known", [0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    for other, same in {
        box("on it", [0.5, 1.5, 2.5], first=0): True,
        box("before it", [-20.0, -19.0], first=6): False,  # no common frame
        box("beside it", [0.0, 1.0, 2.0], y=2.1): False,
        box("turned beside it", [0.0, 1.0, 2.0], y=2.9, yaw=np.pi / 2): True,  # it reaches 2 m to its sides
        box("turned, farther", [0.0, 1.0, 2.0], y=3.1, yaw=np.pi / 2): False,
        box("across its corner", [3.0], y=2.0, yaw=-np.pi / 4): False,  # their bounds overlap, they do not
        box("its corner at a side", [0.0], y=3.2, yaw=np.pi / 4): False,  # they lie apart along that side alone
        box("passing", [-30.0, -20.0, 2.0, 23.0, 34.0, 45.0]): False,  # one of six
        box("meeting", [-30.0, -20.0, 2.0, 3.0, 34.0, 45.0]): True,  # two of six
    }.items():
        assert joined([known], [other]) == ((known,) if same else (known, other)), other.name


def test_crooked_annotations_are_not_doubled():
    """Boxes that are off, of every fifth sweep, between its instants, or of a part of the way."""
    path, times = np.arange(21.0) * 1.5, np.linspace(0.0, 1.0, 21)
    found = replace(box("found", path.tolist()), times=torch.from_numpy(times), found=True)
    slow = replace(box("slow", path[::5].tolist(), y=0.5), frames=torch.arange(0, 21, 5))
    for annotated in (
        replace(slow, times=torch.from_numpy(times[::5])),
        # Annotated 40 ms late, where the car is by then: 0.6 m ahead.
        replace(
            box("late", (path[:20:5] + 0.6).tolist()),
            frames=torch.arange(0, 20, 5),
            times=torch.from_numpy(times[:20:5] + 0.4 / 20),
        ),
        replace(box("ends", path[:4].tolist(), y=-0.5), times=torch.from_numpy(times[:4])),
    ):
        assert joined([annotated], [found]) == (annotated,), annotated.name
    after = replace(found, frames=found.frames + 4, times=found.times)
    short = replace(box("short", path[:4].tolist()), times=torch.from_numpy(times[:4]))
    assert joined([short], [after]) == (short, after)  # where one ends, the other goes on
