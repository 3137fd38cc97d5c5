"""Latency by three clocks, on renders of known length and on a scene."""

import itertools
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet import ops
from sparsestreet.evaluation import speed
from sparsestreet.evaluation.speed import frame_image, instants, measure_latency
from sparsestreet.noise import Calibration
from sparsestreet.records.summary import FRAME, RASTER, RIG
from sparsestreet.scene import rendering
from sparsestreet.scene.graph import SceneGraph
from tests.evaluation.frames import make_frame
from tests.evaluation.scenes import OPTIONS, masked_scene, replace_render, small_scene

FRAMES = [make_frame(index) for index in range(3)]
SCENE = small_scene()
BLACK = torch.zeros(9, 12, 3)


def measure(monkeypatch, colors, frames=FRAMES, **protocol):
    replace_render(monkeypatch, lambda view: BLACK if (image := colors(view)) is None else image, speed)
    return measure_latency(SCENE, frames, OPTIONS, **protocol)


@pytest.fixture
def steady(monkeypatch):
    """No calibration loop runs."""
    monkeypatch.setattr(speed, "calibrate", lambda device: Calibration(1.0, 0.0, None))


@pytest.mark.lengthy
@pytest.mark.usefixtures("steady")
def test_percentiles_of_known_durations(monkeypatch):
    """On a clock that only the renders move."""
    now = [10.0]
    monkeypatch.setattr(speed.time, "perf_counter", lambda: now[0])
    calls = []
    durations = np.random.default_rng(0).gamma(2, 5, 120)

    def colors(view):
        calls.append(view.frame_index)
        # Warm-up renders are slow: one of them in the statistics would show.
        now[0] += 5.0 if len(calls) <= 7 else durations[len(calls) - 8] / 1000

    latency = measure(monkeypatch, colors, warmup=7, repeats=60)
    frame, rig, raster = (latency.clocks[name] for name in (FRAME, RIG, RASTER))
    # A double of about 50 s holds 1e-14 s; differences are in milliseconds.
    for clock, taken in ((frame, durations[:60]), (rig, durations[60:])):  # every instant has one camera
        expected = np.percentile(taken, [50, 90, 99])
        np.testing.assert_allclose((clock.p50, clock.p90, clock.p99), expected, rtol=0, atol=1e-8)
    assert (raster.p50, raster.p99) == (0.0, 0.0)  # it renders no view
    assert latency.p50 == frame.p50
    assert (frame.repeats, rig.repeats, raster.repeats, latency.warmup, latency.views) == (60, 60, 60, 7, 3)
    assert latency.threads == torch.get_num_threads()
    assert latency.device.startswith("cpu: ")
    assert calls[7:67] == [0, 1, 2] * 20
    assert "60 renders cycling through 3 views after 7 warm-up renders" in latency.protocol


@pytest.mark.usefixtures("steady")
def test_a_rig_is_all_cameras_of_an_instant(monkeypatch):
    """Two instants of two and one camera, given out of order; each render takes a second."""
    frames = [make_frame(1, 0), replace(make_frame(0, 1), time=0.06), make_frame(0, 0)]  # at times of their own
    assert [[view.camera_index for view in rig] for rig in instants(frames)] == [[1, 0], [0]]
    now = [0.0]
    monkeypatch.setattr(speed.time, "perf_counter", lambda: now[0])

    def colors(view):
        now[0] += 1.0

    latency = measure(monkeypatch, colors, frames, warmup=1, repeats=3)
    assert latency.clocks[FRAME].p99 == 1000.0
    # Two renders, one, two.
    assert (latency.clocks[RIG].p50, latency.clocks[RIG].p99) == (2000.0, 2000.0)


@pytest.mark.lengthy
@pytest.mark.usefixtures("steady")
def test_what_is_closed_is_taken_out_for_each_time_of_a_rig_before_the_clock_starts(monkeypatch):
    """Of two instants of two cameras that fire 60 ms apart; the scene of each time is made once for a rig's turns."""
    views = [
        replace(make_frame(index, camera), time=0.1 * index + 0.06 * camera) for index in (0, 1) for camera in (0, 1)
    ]
    running, made = [False], []

    def tick():
        running[0] = not running[0]
        return 0.0

    def without(scene, time, true=speed.without_closed_rows):
        assert not running[0], "a scene is made while the clock runs"
        made.append(time)
        return true(scene, time)

    monkeypatch.setattr(speed.time, "perf_counter", tick)
    monkeypatch.setattr(speed, "without_closed_rows", without)
    measure_latency(masked_scene(), views, OPTIONS, warmup=1, repeats=4)
    # One a time for each of the three clocks, and the first for the warm-up before them.
    assert len(made) <= 3 * 4 + 1
    assert set(made) == {0.0, 0.06, 0.1, 0.16}


@pytest.mark.lengthy
def test_real_clock_sees_the_whole_render(monkeypatch):
    frame = measure(monkeypatch, lambda view: time.sleep(0.003), warmup=2, repeats=50).clocks[FRAME]
    assert 3 <= frame.p50 <= frame.p90 <= frame.p99
    assert frame.p50 < 30  # sleep never wakes early; ten times late would be a unit mistake, not a busy machine


@pytest.fixture
def stopped(monkeypatch):
    """A clock that stands still, in milliseconds; ``slowed`` makes a function move it."""
    now = [0.0]
    monkeypatch.setattr(speed.time, "perf_counter", lambda: now[0] / 1000)

    def slowed(place, name, milliseconds, true=None):
        true = getattr(place, name) if true is None else true

        def slow(*given, **named):
            now[0] += milliseconds
            return true(*given, **named)

        monkeypatch.setattr(place, name, slow)

    return slowed


@pytest.mark.usefixtures("steady")
def test_the_scene_is_what_is_timed(stopped):
    """No render is replaced here: a scene takes 2 ms to assemble, and 5 ms to splat, which is all that "raster" holds.

    The instants have one camera each.
    """
    stopped(SceneGraph, "gaussians_at", 2.0)
    for module in (rendering, speed):
        stopped(module, "splat", 5.0, ops.splat)
    latency = measure_latency(SCENE, FRAMES, OPTIONS, warmup=1, repeats=5)
    found = {name: (clock.p50, clock.p99) for name, clock in latency.clocks.items()}
    expected = {RASTER: 5.0, FRAME: 7.0, RIG: 7.0}
    assert found == {name: pytest.approx((time, time)) for name, time in expected.items()}
    assert latency.removed == {}


@pytest.mark.lengthy
@pytest.mark.usefixtures("steady")
def test_taking_closed_rows_out_is_no_part_of_a_frame(stopped):
    """Somebody who wants to be fast does so beforehand."""
    stopped(speed, "without_closed_rows", 3.0)
    latency = measure_latency(masked_scene(), FRAMES[:2], OPTIONS, warmup=1, repeats=4)
    assert {name: clock.p99 for name, clock in latency.removed.items()} == {RASTER: 0.0, FRAME: 0.0, RIG: 0.0}


def test_an_image_for_a_screen_is_clamped_and_rounded(monkeypatch):
    colors = torch.tensor([-0.5, 0.5, 1.5]).expand(9, 12, 3)
    replace_render(monkeypatch, lambda view: colors, speed)
    image = frame_image(SCENE, FRAMES[0], OPTIONS)
    assert image.dtype == torch.uint8
    assert image[0, 0].tolist() == [0, 128, 255]


@pytest.mark.lengthy
@pytest.mark.usefixtures("steady")
def test_closed_gaussians_are_timed_masked_and_removed(monkeypatch):
    """The mask closes two rows at time 0 and one at time 0.1; what is removed is not in the scene that is drawn."""
    drawn = []

    def render(scene, view, *, options, true=speed.render):
        drawn.append((view.time, scene.counts()["road"]))
        return true(scene, view, options=options)

    monkeypatch.setattr(speed, "render", render)
    latency = measure_latency(masked_scene(), FRAMES[:2], OPTIONS, warmup=1, repeats=4)
    kept, removed = drawn[:9], drawn[9:]
    assert {rows for _, rows in kept} == {4}
    assert set(removed) == {(0.0, 2), (0.1, 3)}
    assert set(latency.removed) == set(latency.clocks)
    assert latency.removed[FRAME].repeats == 4


@pytest.mark.usefixtures("steady")
def test_cuda_is_waited_for_around_each_render(monkeypatch):
    log = []
    monkeypatch.setattr(type(SCENE), "device", torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: log.append(("wait", device.type)))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "fake")
    monkeypatch.setattr(speed.time, "perf_counter", lambda: log.append("clock") or 0.0)
    monkeypatch.setattr(speed, "splat", lambda *given, **how: log.append("splat"))
    latency = measure(monkeypatch, lambda view: log.append("render"), warmup=1, repeats=2)
    wait = ("wait", "cuda")

    def timed(what):
        return [wait, "clock", what, wait, "clock"] * 2

    assert log == ["render", *timed("render"), *timed("render"), *timed("splat")]
    assert latency.device == "cuda: fake"


def test_noise_is_that_of_before_and_after(monkeypatch):
    loops = itertools.chain([Calibration(1.0, 0.01, 3.5), Calibration(1.5, 0.02, 9.0)])
    monkeypatch.setattr(speed, "calibrate", lambda device: next(loops))
    noise = measure_latency(SCENE, FRAMES, OPTIONS, warmup=1, repeats=1).noise
    assert (noise.before, noise.after, noise.drift, noise.load_average, noise.quiet) == (0.01, 0.02, 0.5, 3.5, False)


@pytest.mark.parametrize(("frames", "warmup", "repeats"), [([], 20, 50), (FRAMES, 0, 50), (FRAMES, 1, 0)])
def test_nothing_to_time_is_an_error(frames, warmup, repeats):
    with pytest.raises(ValueError, match="at least one view, warm-up and repeat"):
        measure_latency(SCENE, frames, OPTIONS, warmup=warmup, repeats=repeats)
