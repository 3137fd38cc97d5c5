"""Phases of a step: which steps are watched, what their record holds, floors, and what is said and drawn of it."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Annotation

from sparsestreet.bench import step
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.step import (
    Floor,
    PhaseRecord,
    StepRecord,
    StepWatch,
    StepWindow,
    StepWork,
    floors,
    lines,
    measured_bandwidth,
    measured_peak,
    run_step,
)
from sparsestreet.bench.timing import TimeSpread
from sparsestreet.phases import PhaseRecorder, WallClock, phase
from sparsestreet.scene.rendering import render
from tests.bench.test_records import PROVENANCE
from tests.training.stubs import StubTrainer, background, frame_at, make_system, rigid
from tests.typed import as_a

WINDOW = StepWindow(first=2, timed=3, counted=2)
WORK = StepWork(rows=10, visible=4, terms=4, samples=100, parameters=50, size=(2, 3), sky_pixels=5)


def spread(median: float, iqr: float | None = 0.25) -> TimeSpread:
    return TimeSpread(median, median / 2, iqr, 3)


RECORD = StepRecord(
    "train x",
    {"background": 1234, "rigid": 56},
    640,
    480,
    spread(40.0),
    spread(16.0),
    70.0,
    12.0,
    34.0,
    (
        PhaseRecord("splat", spread(10.0), 5.0, Floor(8.0, 9.0), 2.5),
        PhaseRecord("scene", spread(20.0, None), 60.0, None, None),
        PhaseRecord("tiny", spread(0.25), 1.0, None, None),
        PhaseRecord("splat backward", spread(6.0), 4.0, Floor(1.0), 3.0),
    ),
)


def test_bytes_by_hand():
    found = floors([WORK])
    assert found["optimizer"].bytes == 50 * 7 * 4
    # Three scales and an opacity of 10 rows, read and written.
    assert found["scene"].bytes == found["scene backward"].bytes == 2 * 10 * 4 * 4
    # 11 numbers of all rows and 12 of the four that are drawn are read; 11 + 12 + 2 of all rows are written.
    assert found["splat"].bytes == 4 * (110 + 48)
    assert found["splat backward"].bytes == 4 * (110 + 48 + 250)
    assert found["splat backward"].flops == 65 * 100
    assert found["sky"].bytes == 4 * (6 + 5 * 6)


def test_the_mean_over_steps_and_no_step():
    other = StepWork(rows=10, visible=4, terms=4, samples=None, parameters=150, size=(2, 3), sky_pixels=5)
    assert floors([other])["optimizer"].bytes == 150 * 28
    assert "splat" not in floors([other])
    assert floors([]) == {}
    assert floors([WORK, StepWork(10, 4, 4, 300, 150, (2, 3), 5)])["splat"].flops == 36 * 200


def test_the_slower_of_memory_and_arithmetic_decides():
    assert Floor(8.0, 3.0).seconds(4.0, 1.0) == pytest.approx(3.0)
    assert Floor(8.0, 1.0).seconds(4.0, 1.0) == pytest.approx(2.0)


def test_bandwidth_and_peak_are_the_best_of_several(monkeypatch):
    """On a clock of which six calls take 2, 0.5, 1, 1, 1 and 4 seconds."""
    ticks = iter(2 * [0.0, 2.0, 2.0, 2.5, 3.0, 4.0, 4.0, 5.0, 5.0, 6.0, 6.0, 10.0])
    monkeypatch.setattr(step.time, "perf_counter", lambda: next(ticks))
    assert measured_bandwidth(torch.device("cpu"), megabytes=4) == 2 * 4 * 2**20 / 0.5
    assert measured_peak(torch.device("cpu"), size=4) == 2 * 64 / 0.5


def test_a_window_of_a_run_is_timed_then_counted(monkeypatch):
    """Steps 3, 4, 5 on a clock of which each rendering takes a second; 6 and 7 are counted, and end training."""
    now = [0.0]
    monkeypatch.setattr("sparsestreet.phases.time.perf_counter", lambda: now[0])
    work = []
    monkeypatch.setattr(step.StepWork, "of", staticmethod(lambda *given: work.append(given) or WORK))
    seen = []
    monkeypatch.setattr(step, "_samples", lambda rendering: seen.append(rendering) or 7)
    monkeypatch.setattr(step, "peak_megabytes", lambda device: (1.0, 100 * now[0]))
    system = make_system({"background": background(5)})
    take = system.training_step

    def slow(frame: Any, index: int) -> torch.Tensor:
        with phase("a part"):
            now[0] += 1.0
        return take(frame, index)

    monkeypatch.setattr(system, "training_step", slow)
    watch = StepWatch(WINDOW)
    trainer = StubTrainer(system, [watch], max_steps=100)
    trainer.should_stop = False
    ended = []
    for _ in range(WINDOW.last):
        trainer.train(1, frame_at())
        ended.append(trainer.should_stop)
    assert ended == [False] * 6 + [True]
    assert [seconds["a part"] for seconds in watch.seconds] == [1.0] * 3
    assert watch.work == [WORK] * 3
    assert [given[0] for given in work] == [system] * 3
    assert [given[1] for given in work] == seen
    assert len(set(map(id, seen))) == 3  # each step's own
    assert {given[2] for given in work} == {7}
    assert watch.operations["loss photometric"] > 0
    assert watch.unwatched == pytest.approx(1.0)  # of step 2 alone: the first does not count
    assert watch.peak_mb == 500.0  # after step 5
    before = Counter(watch.operations)
    trainer.train(1, frame_at())
    assert watch.operations == before


def test_operations_belong_to_the_innermost_phase_and_views_are_none():
    recorder, operations, values = PhaseRecorder(WallClock()), Counter[str](), torch.ones(4)
    recorder.start()
    with step.CountedOperations(recorder, operations):
        values.add(1.0)
        with phase("a part"):
            values.view(2, 2).add(1.0, alpha=2.0).mul(2.0)
    recorder.stop()
    assert operations == {"rest": 1, "a part": 2}


def test_samples_are_those_of_the_rendering_itself():
    """Not of one that took its workspace back before: of two sizes, each counts its own."""
    system = make_system({"background": background(30)})
    small, large = (render(system.scene, frame_at(0, width, width // 2)) for width in (16, 48))
    (large.rgb.sum() + small.rgb.sum()).backward()
    few, many = step._samples(small), step._samples(large)
    assert few is not None
    assert many is not None
    assert 0 < few < many


def watched(window: StepWindow) -> StepWatch:
    """Two timed steps of 4 and 6 ms, of which the op takes 1.5 and 2; ten operations in two counted steps."""
    watch = StepWatch(window)
    watch.seconds = [
        {"splat": 1e-3, "splat backward": 0.5e-3, "scene": 2.5e-3},
        {"splat": 1.25e-3, "splat backward": 0.75e-3, "scene": 3e-3, "once": 1e-3},
    ]
    watch.work = [WORK, StepWork(10, 4, 4, 300, 50, (7, 9), 5)]
    watch.operations = Counter({"scene": 6, "splat": 3, "counted": 1})
    return watch


def test_a_record_has_medians_operations_and_floors(monkeypatch, tmp_path):
    watch = watched(StepWindow(0, 2, 2))
    watch.device, watch.unwatched, watch.peak_mb = torch.device("cuda"), 0.003, 1234.5
    monkeypatch.setattr(step, "StepWatch", lambda window: watch if window == WINDOW else None)
    asked = []
    monkeypatch.setattr(step, "measured_bandwidth", lambda device: asked.append(device) or 4e9)
    monkeypatch.setattr(step, "measured_peak", lambda device: asked.append(device) or 5e9)
    monkeypatch.setattr(step, "device_name", lambda device: f"a {device.type}")
    monkeypatch.setattr(step, "draw_step", lambda record, folder: asked.append((record, folder)) or [Path("one.svg")])
    system = make_system({"background": background(5), "rigid": rigid(3)})
    file, said = RecordFile(tmp_path / "step.jsonl", PROVENANCE), []
    record = run_step("train x", lambda one: asked.append(one) or system, WINDOW, file, tmp_path / "o", said.append)
    # Where the steps ran: when training has ended, the system is on the CPU.
    assert asked == [watch, torch.device("cuda"), torch.device("cuda"), (record, tmp_path / "o")]
    assert (record.device, record.unwatched_ms, record.peak_device_mb) == ("a cuda", pytest.approx(3.0), 1234.5)
    assert (record.what, record.gaussians, record.width, record.height) == (
        "train x", {"background": 5, "rigid": 3}, 9, 7,
    )  # fmt: skip
    assert (record.step.median, record.step.minimum, record.step.repeats) == pytest.approx((5.0, 4.0, 2))
    assert (record.op.median, record.op.minimum) == pytest.approx((1.75, 1.5))
    assert (record.operations, record.bandwidth_gb_s, record.peak_gflops) == pytest.approx((5.0, 4.0, 5.0))
    assert record.ratio == pytest.approx(5 / 1.75)
    # The longest first; a phase that a step lacks took nothing; what was counted alone took nothing, too.
    found = {one.name: one for one in record.phases}
    assert list(found) == ["scene", "splat", "splat backward", "once", "counted"]
    assert [one.time.median for one in record.phases] == pytest.approx([2.75, 1.125, 0.625, 0.5, 0.0])
    assert [one.operations for one in record.phases] == [3.0, 1.5, 0.0, 0.0, 0.5]
    least = floors(watch.work)
    assert found["splat"].floor == least["splat"]
    assert found["splat"].floor_ms == pytest.approx(1e3 * least["splat"].seconds(4e9, 5e9))
    assert (found["once"].floor, found["once"].floor_ms) == (None, None)
    (line,) = read_records(file.path)
    assert (line["kind"], line["what"], line["phases"][0]["name"]) == ("step", "train x", "scene")
    assert said == [*lines(record), "drawn: one.svg"]


def test_the_table_of_a_step():
    """Shares are of the step's median: 10, 20, 0.25 and 6 of 40 ms."""
    first, header, *phases, whole, where, floor = lines(RECORD)
    assert where == "on cpu"
    full = replace(RECORD, device="a card", unwatched_ms=4.25, peak_device_mb=12345.0)
    assert lines(full)[-2] == "on a card; 4.25 ms unwatched, moved views included; 12,345 MB of the device"
    assert first == "train x: background 1,234, rigid 56, 640x480"
    assert header.split() == ["phase", "ms", "iqr", "share", "operations", "least", "ms", "distance"]
    assert [line.split() for line in phases] == [
        ["splat", "10.00", "0.25", "25%", "5", "2.50", "4.0x"],
        ["scene", "20.00", "0.00", "50%", "60"],
        ["tiny", "0.25", "0.25", "1%", "1"],
        ["splat", "backward", "6.00", "0.25", "15%", "4", "3.00", "2.0x"],
    ]
    assert whole == f"a step {RECORD.step}; 2.50 times its op {RECORD.op}; 70 operations"
    assert floor == "floors: 12 GB/s (addition in place), 34 GFLOP/s (float32 matrix product)"


def test_the_picture_of_a_step(monkeypatch, tmp_path):
    """A bar a phase that takes a hundredth of the step, its floor inside."""
    drawn: list[tuple[Figure, Any, str]] = []
    monkeypatch.setattr(step, "save_figure", lambda *given: drawn.append(given) or [Path("a.svg")])
    assert step.draw_step(RECORD, tmp_path) == [Path("a.svg")]
    ((figure, folder, name),) = drawn
    assert (folder, name) == (tmp_path, "step")
    (axes,) = figure.axes
    drawn_bars = [as_a(Rectangle, bar) for bar in axes.patches]
    bars = [(bar.get_y() + bar.get_height() / 2, bar.get_width(), to_hex(bar.get_facecolor())) for bar in drawn_bars]
    op, rest, floor = "#0072b2", "#e69f00", "#333333"
    expected = [(0, 10.0, op), (0, 2.5, floor), (1, 20.0, rest), (2, 6.0, op), (2, 3.0, floor)]
    assert [(pytest.approx(place), width, color) for place, width, color in expected] == bars
    assert [text.get_text() for text in axes.get_yticklabels()] == ["splat", "scene", "splat backward"]
    assert [text.get_text() for text in axes.texts] == [
        " 10.0 ms, 5 operations, 4.0 x its floor",
        " 20.0 ms, 60 operations",
        " 6.0 ms, 4 operations, 2.0 x its floor",
    ]
    assert [as_a(Annotation, text).xy for text in axes.texts] == [(10.0, 0), (20.0, 1), (6.0, 2)]
    assert axes.get_xlim()[1] == pytest.approx(31.0)
    assert axes.get_ylim()[0] > axes.get_ylim()[1]
    assert axes.get_title() == "train x: 40.0 ms a step, 2.50 x its op, 70 operations"
