"""Latency on renders of known length."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sparsestreet.evaluation import speed
from sparsestreet.evaluation.speed import measure_latency
from tests.evaluation.frames import make_frame

FRAMES = [make_frame(index) for index in range(3)]


class FakeClock:
    """A clock that only the renders move."""

    def __init__(self, monkeypatch) -> None:
        self.now = 10.0
        monkeypatch.setattr(speed.time, "perf_counter", lambda: self.now)


def test_percentiles_of_known_durations(monkeypatch):
    clock = FakeClock(monkeypatch)
    calls = []
    durations = np.random.default_rng(0).gamma(2, 5, 60)

    def render(frame):
        calls.append(frame.frame_index)
        # Warm-up renders are slow: one of them in the statistics would show.
        clock.now += 5.0 if len(calls) <= 7 else durations[len(calls) - 8] / 1000
        return SimpleNamespace(rgb=torch.zeros(2, 2, 3))

    latency = measure_latency(render, FRAMES, warmup=7, repeats=60)
    expected = np.percentile(durations, [50, 90, 99])
    # A double of about 50 s holds 1e-14 s; differences are in milliseconds.
    np.testing.assert_allclose((latency.p50, latency.p90, latency.p99), expected, rtol=0, atol=1e-8)
    assert latency.median == latency.p50
    assert (latency.repeats, latency.warmup, latency.views) == (60, 7, 3)
    assert latency.threads == torch.get_num_threads()
    assert latency.device.startswith("cpu: ")
    assert calls[7:] == [0, 1, 2] * 20
    assert "60 renders cycling through 3 views after 7 warm-up renders" in latency.protocol


def test_real_clock_sees_the_whole_render():
    def render(frame):
        time.sleep(0.003)
        return SimpleNamespace(rgb=torch.zeros(2, 2, 3))

    latency = measure_latency(render, FRAMES, warmup=2, repeats=50)
    assert 3 <= latency.p50 <= latency.p90 <= latency.p99
    assert latency.p50 < 30  # sleep never wakes early; ten times late would be a unit mistake, not a busy machine


def test_cuda_is_waited_for_around_each_render(monkeypatch):
    log = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: log.append(("wait", device.type)))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "fake")
    monkeypatch.setattr(speed.time, "perf_counter", lambda: log.append("clock") or 0.0)

    def render(frame):
        log.append("render")
        return SimpleNamespace(rgb=SimpleNamespace(device=torch.device("cuda")))

    latency = measure_latency(render, FRAMES, warmup=1, repeats=2)
    wait = ("wait", "cuda")
    assert log == ["render", *[wait, "clock", "render", wait, "clock"] * 2]
    assert latency.device == "cuda: fake"


@pytest.mark.parametrize(("frames", "warmup", "repeats"), [([], 20, 50), (FRAMES, 0, 50), (FRAMES, 1, 0)])
def test_nothing_to_time_is_an_error(frames, warmup, repeats):
    with pytest.raises(ValueError, match="at least one frame, warm-up and repeat"):
        measure_latency(lambda frame: None, frames, warmup=warmup, repeats=repeats)
