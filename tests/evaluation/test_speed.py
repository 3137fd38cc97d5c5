"""Latency on renders of known length."""

import time

import numpy as np
import pytest
import torch

from sparsestreet.evaluation import speed
from sparsestreet.evaluation.speed import measure_latency
from tests.evaluation.frames import make_frame
from tests.evaluation.scenes import OPTIONS, replace_render, small_scene

FRAMES = [make_frame(index) for index in range(3)]
SCENE = small_scene()


def measure(monkeypatch, colors, **protocol):
    replace_render(monkeypatch, colors, speed)
    return measure_latency(SCENE, FRAMES, OPTIONS, **protocol)


def test_percentiles_of_known_durations(monkeypatch):
    """On a clock that only the renders move."""
    now = [10.0]
    monkeypatch.setattr(speed.time, "perf_counter", lambda: now[0])
    calls = []
    durations = np.random.default_rng(0).gamma(2, 5, 60)

    def colors(view):
        calls.append(view.frame_index)
        # Warm-up renders are slow: one of them in the statistics would show.
        now[0] += 5.0 if len(calls) <= 7 else durations[len(calls) - 8] / 1000

    latency = measure(monkeypatch, colors, warmup=7, repeats=60)
    expected = np.percentile(durations, [50, 90, 99])
    # A double of about 50 s holds 1e-14 s; differences are in milliseconds.
    np.testing.assert_allclose((latency.p50, latency.p90, latency.p99), expected, rtol=0, atol=1e-8)
    assert latency.median == latency.p50
    assert (latency.repeats, latency.warmup, latency.views) == (60, 7, 3)
    assert latency.threads == torch.get_num_threads()
    assert latency.device.startswith("cpu: ")
    assert calls[7:] == [0, 1, 2] * 20
    assert "60 renders cycling through 3 views after 7 warm-up renders" in latency.protocol


def test_real_clock_sees_the_whole_render(monkeypatch):
    latency = measure(monkeypatch, lambda view: time.sleep(0.003), warmup=2, repeats=50)
    assert 3 <= latency.p50 <= latency.p90 <= latency.p99
    assert latency.p50 < 30  # sleep never wakes early; ten times late would be a unit mistake, not a busy machine


def test_the_scene_is_what_is_timed():
    """No render is replaced here."""
    assert measure_latency(SCENE, FRAMES, OPTIONS, warmup=1, repeats=3).p50 > 0


def test_cuda_is_waited_for_around_each_render(monkeypatch):
    log = []
    monkeypatch.setattr(type(SCENE), "device", torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: log.append(("wait", device.type)))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "fake")
    monkeypatch.setattr(speed.time, "perf_counter", lambda: log.append("clock") or 0.0)
    latency = measure(monkeypatch, lambda view: log.append("render"), warmup=1, repeats=2)
    wait = ("wait", "cuda")
    assert log == ["render", *[wait, "clock", "render", wait, "clock"] * 2]
    assert latency.device == "cuda: fake"


@pytest.mark.parametrize(("frames", "warmup", "repeats"), [([], 20, 50), (FRAMES, 0, 50), (FRAMES, 1, 0)])
def test_nothing_to_time_is_an_error(frames, warmup, repeats):
    with pytest.raises(ValueError, match="at least one view, warm-up and repeat"):
        measure_latency(SCENE, frames, OPTIONS, warmup=warmup, repeats=repeats)
