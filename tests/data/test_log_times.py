"""What writers take from a log that does not tell it: stamps of all times, the vehicle, what a class name means."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log_times import LogTimes, stamps_of_frames
from sparsestreet.data.roles import role_of
from sparsestreet.data.vehicle import dataset_from_camera, vehicle_of
from sparsestreet.geometry import quaternions as quat
from sparsestreet.types import Sweep, Track
from tests.data.streets import make_log

CONF = Path(__file__).parents[2] / "conf"
START = 1_532_402_927_600_000_001
CLASSES = sorted(path.stem for path in (CONF / "data").glob("*.yaml"))


def clocked(**changes):
    """Two cameras, the second 30 ms later; stamps that doubles of seconds cannot hold."""
    log = make_log(num_frames=3, **changes)
    stamps = [START + 100_000_000 * view.indices[0] + 30_000_000 * view.indices[1] for view in log.views]
    span = stamps[-1] - stamps[0]
    frames = [replace(one, stamp=at, time=(at - START) / span) for one, at in zip(log.frames, stamps, strict=True)]
    return replace(log, frames=as_frames(frames)), stamps


def sweep(index: int, time: float, stamp: int | None) -> Sweep:
    return Sweep(index, time, torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0).bool(), stamp=stamp)


def test_stamps_of_normalized_times_are_the_log_s_own():
    log, stamps = clocked()
    times = LogTimes.of(log)
    assert (times.first, times.span, times.invented, times.shift) == (START, 230_000_000, False, 0)
    assert [times.stamp(view.time) for view in log.views] == stamps
    assert [times.of_view(view) for view in log.views] == stamps
    assert times.time(START + 23_000_000) == pytest.approx(0.1)
    assert times.losses() == ()


def test_a_log_of_one_instant_with_a_sweep_of_another():
    log = make_log(num_frames=1, num_cameras=1, sweeps=(sweep(0, 1.0, START + 50),))
    log = replace(log, frames=as_frames([replace(log.frames[0], stamp=START, time=0.0)]))
    assert (LogTimes.of(log).first, LogTimes.of(log).span) == (START, 50)
    assert stamps_of_frames(log, LogTimes.of(log)) == (START + 50,)
    alone = replace(log, sweeps=Sweeps.of(()))
    assert (LogTimes.of(alone).first, LogTimes.of(alone).span) == (START, 0)


def test_stamps_that_a_layout_cannot_hold_are_moved_by_whole_seconds():
    log, _ = clocked()
    times = LogTimes.of(log, START + 1)
    assert (times.first, times.shift) == (START + 1_000_000_000, 1_000_000_000)
    assert times.of_view(log.views[0]) == times.stamp(0.0) == times.first
    assert times.losses() == ("all stamps are 1 s later: the layout has none before 0",)
    assert LogTimes.of(log, START).shift == 0


def test_a_log_without_a_clock():
    log = make_log(num_frames=3)
    times = LogTimes.of(log)
    assert [times.of_view(view) for view in log.views[::2]] == [1_000_000_000, 1_100_000_000, 1_200_000_000]
    assert "the log has no clock" in times.losses()[0]
    track = Track("car", "car", torch.tensor([0, 2]), torch.eye(4).double().repeat(2, 1, 1), torch.ones(3))
    assert times.timed(track, 3).times.tolist() == [0.0, 1.0]


def test_frames_have_the_stamps_of_their_sweeps_or_of_their_middle_images():
    log, stamps = clocked(sweeps=(sweep(1, 0.5, START + 115_000_000),))
    assert stamps_of_frames(log, LogTimes.of(log)) == (stamps[1], START + 115_000_000, stamps[5])
    late = replace(log, sweeps=Sweeps.of((sweep(0, 1.0, START + 400_000_000),)))
    with pytest.raises(ValueError, match="the stamps of frames 0 and 1 of 'tiny' do not increase"):
        stamps_of_frames(late, LogTimes.of(log))
    lacking = replace(log, frames=log.frames.where(lambda view: view.indices[0] != 2))
    with pytest.raises(ValueError, match=r"frames \[2\] of 'tiny' have no image and no sweep"):
        stamps_of_frames(lacking, LogTimes.of(log))


def test_the_vehicle_holds_the_cameras_and_has_the_boxes_upright():
    """Cameras look along z, with y down: the vehicle's x is z of the world, its z is -y, turned as the boxes are."""
    log, stamps = clocked()
    lean = quat.to_matrix(quat.from_rotation_vector(torch.tensor([0.0, 0, 0.1], dtype=torch.float64)))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = lean @ torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    boxes = Track("car", "car", torch.tensor([0, 2]), pose.repeat(2, 1, 1), torch.ones(3))
    log = replace(log, tracks=(boxes,))
    vehicle = vehicle_of(log, LogTimes.of(log), (1.0, 2.0, 3.0))
    for view, stamp in zip(log.views, stamps, strict=True):
        mounted = vehicle.at(stamp) @ vehicle.mounts[view.indices[1]]
        # The second camera is 1 m beside the first, which drives 1 m a frame: straight on, so that a mount is exact.
        torch.testing.assert_close(mounted, dataset_from_camera(log, view), rtol=0, atol=1e-9)
    torch.testing.assert_close(vehicle.mounts[0][:3, 3], torch.tensor([1.0, 2.0, 3.0]).double())
    torch.testing.assert_close(vehicle.at(START)[:3, :3], pose[:3, :3], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", CLASSES)
def test_names_mean_what_the_configuration_of_their_data_set_says(name):
    classes = dict(OmegaConf.to_container(OmegaConf.load(CONF / "data" / f"{name}.yaml"))).get("classes")  # pyright: ignore
    if not isinstance(classes, dict):
        pytest.skip(f"data={name} has no classes of its own")
    for role, names in classes.items():
        assert {one: role_of(one) for one in names} == dict.fromkeys(names, role)
