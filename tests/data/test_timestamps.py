"""Stamps, seconds and the rate of a log, on clocks that are exact, rounded, irregular or broken."""

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction

import pytest
import torch

from sparsestreet.data.lazy import Frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import LogError
from sparsestreet.data.timestamps import LogClock, read_stamps
from sparsestreet.types import Frame, Shutter, View
from tests.data.plan import make_log
from tests.typed import there

SINCE_1970 = 1_532_402_927_600_000_251
"""Nanoseconds of one nuScenes drive: as a double of seconds it would be rounded to steps of 238 ns."""


def test_a_file_is_read_to_the_nanosecond(tmp_path):
    path = tmp_path / "timestamps.txt"
    path.write_text("1532402927.600000251\n\n 1532402927.700000252 \n1.5324029278000002531e+09\n")
    assert read_stamps(path, 3) == (SINCE_1970, SINCE_1970 + 100_000_001, SINCE_1970 + 200_000_002)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("0.0\n0.1\n", "a log of 3 frames has 3 stamps, got 2"),
        ("0.0\n0.1\n0.2\n0.3\n", "got 4"),
        ("", "got 0"),
        ("0.0\n0.2\n0.1\n", "must increase, but frame 2 lies 0.1 s before frame 1"),
        ("0.0\n0.1\n0.1\n", "must increase, but frame 2 lies 0 s before frame 1"),
        ("0.0\n0.1\n0.1000000001\n", "must increase"),  # less than a nanosecond
        ("0.0\nnoon\n0.2\n", "'noon' is no number"),
        ("0.0\n0.1 0.2\n0.3\n", "'0.1 0.2' is no number"),
        ("0.0\nnan\n0.2\n", "'nan' is no number"),
        ("0.0\n0.1\ninf\n", "'inf' is no number"),
        ("0.0\n0.1\n1e99999999\n", "is no number"),
    ],
)
def test_a_broken_file_is_a_problem_with_a_remedy(content, said, tmp_path):
    path = tmp_path / "timestamps.txt"
    path.write_text(content)
    with pytest.raises(LogError, match=r"timestamps\.txt") as caught:
        read_stamps(path, 3)
    (problem,) = caught.value.problems
    assert said in problem.message
    assert "on a line of its own, or remove the file" in problem.remedy


def test_bytes_that_are_no_text_are_a_problem(tmp_path):
    path = tmp_path / "timestamps.txt"
    path.write_bytes(b"\xff\xfe0.1")
    with pytest.raises(LogError, match="cannot be read"):
        read_stamps(path, 1)


@pytest.mark.parametrize("stamps", [(1, 2), (1, 2, 2), (3, 2, 1)])
def test_a_clock_is_in_order(stamps):
    with pytest.raises(ValueError, match="give one stamp for each frame, in order"):
        LogClock(3, stamps)


def camera():
    return make_log(1).views[0].camera


def test_views_have_normalized_time_and_that_of_the_clock():
    clock = LogClock(3, (SINCE_1970, SINCE_1970 + 100_000_000, SINCE_1970 + 250_000_001))
    views = [clock.view(camera(), index, 0) for index in range(3)]
    assert [(view.time, view.frame_index, view.camera_index) for view in views] == [
        (0.0, 0, 0),
        (float(Fraction(100_000_000, 250_000_001)), 1, 0),
        (1.0, 2, 0),
    ]
    assert [view.stamp for view in views] == list(there(clock.stamps))
    # One rounding of an exact integer quotient.
    assert [view.seconds for view in views] == [0.0, 0.1, float(Fraction(250_000_001, 10**9))]
    assert clock.moment(2) == (views[2].seconds, views[2].stamp)


def test_images_have_instants_of_their_own():
    """The second camera fires 50 ms before the first, which shares the stamps of the frames, and the lidar 50 after."""
    stamps = tuple(SINCE_1970 + 100_000_000 * frame for frame in range(3))
    early = [stamp - 50_000_000 for stamp in stamps]
    clock = LogClock(3, stamps, [*early, stamps[2] + 50_000_000])
    first = clock.view(camera(), 0, 1, stamp=early[0])
    assert (first.time, first.seconds, first.stamp) == (0.0, -0.05, early[0])
    assert [clock.view(camera(), frame, 0).time for frame in range(3)] == [1 / 6, 0.5, 5 / 6]
    assert [clock.view(camera(), frame, 1, early[frame]).time for frame in range(3)] == [0.0, 1 / 3, 2 / 3]
    assert (clock.time(2, stamps[2] + 50_000_000), clock.moment(2)[0]) == (1.0, 0.2)
    with pytest.raises(ValueError, match=r"lies outside of the clock's .*: name it in LogClock.others"):
        clock.time(0, early[0] - 1)
    with pytest.raises(ValueError, match="lies outside"):
        clock.time(2, stamps[2] + 50_000_001)


@pytest.mark.parametrize("count", [2, 3, 40, 199])
def test_even_stamps_give_the_times_of_a_log_without_a_clock(count):
    clock = LogClock(count, tuple(SINCE_1970 + 99_999_999 * frame for frame in range(count)))
    bare = LogClock(count)
    assert [clock.time(frame) for frame in range(count)] == [bare.time(frame) for frame in range(count)]
    assert LogClock(1, (5,)).time(0) == 0.0


def test_without_a_clock_there_is_normalized_time_alone():
    view = LogClock(1).view(camera(), 0, 0)
    assert (view.time, view.seconds, view.stamp) == (0.0, None, None)
    assert LogClock(5).moment(3) == (None, None)


def test_a_frame_says_all_that_its_view_says():
    view = LogClock(2, (5, 6)).view(camera(), 1, 0)
    frame = Frame.of(view, image=torch.zeros(3, 5, 3, dtype=torch.uint8))
    assert (frame.time, frame.frame_index, frame.camera_index) == (1.0, 1, 0)
    assert (frame.seconds, frame.stamp) == (1e-9, 6)
    assert frame.camera is view.camera


def clocked(stamps: Mapping[tuple[int, int], int | None]) -> DrivingLog:
    """A log whose views of (frame, camera) have these stamps."""
    log = make_log(3, 2)

    def timed(view: View) -> View:
        stamp = stamps[view.indices]
        return replace(view, stamp=stamp, seconds=None if stamp is None else stamp / 1e9)

    return replace(log, frames=Frames([timed(view) for view in log.views], log.frames.load))


def test_a_log_has_the_rate_of_its_mean_step():
    """Steps of 50 and 150 ms, seen by a second camera that fires 20 ms before the first."""
    first = {0: 0, 1: 50_000_000, 2: 200_000_000}
    stamps = {(frame, 0): stamp for frame, stamp in first.items()}
    stamps |= {(frame, 1): stamp - 20_000_000 for frame, stamp in first.items()}
    log = clocked(stamps)
    assert log.stamps == {0: -20_000_000, 1: 30_000_000, 2: 180_000_000}
    assert log.seconds == {0: -0.02, 1: 0.03, 2: 0.18}
    assert log.frame_rate == 10.0  # 2 steps in 0.2 s; the median step would not know which of the two to take


def test_a_log_in_part_without_stamps_or_of_one_frame_has_no_rate():
    stamps = {(frame, number): 10**8 * frame for frame in range(3) for number in range(2)}
    assert clocked(stamps).frame_rate == 10.0
    log = clocked(stamps | {(1, 0): None})
    assert (log.frame_rate, log.stamps, log.seconds) == (None, {}, {})
    assert make_log(3).frame_rate is None
    assert make_log(1).frame_rate is None


def test_a_readout_takes_its_part_of_normalized_time():
    """30 ms of a log of 0.6 s, whose last image was taken 0.1 s after the last frame."""
    clock = LogClock(3, (0, 250_000_000, 500_000_000), others=(600_000_000,))
    shutter = Shutter(torch.zeros(3), torch.zeros(3), "left", 0.03)
    camera = replace(make_log(1).views[0].camera, shutter=shutter)
    read = there(clock.view(camera, 1, 0).camera.shutter)
    assert read.span == pytest.approx(0.05)
    assert (read.seconds, read.direction) == (0.03, "left")
    assert there(LogClock(3).view(camera, 1, 0).camera.shutter).span == 0  # no clock says how long a frame is
    assert there(LogClock(1, (5,)).view(camera, 0, 0).camera.shutter).span == 0
