"""Over which views a run is measured beyond its quality."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.evaluation import extra
from sparsestreet.evaluation.extra import ExtraMetrics, _of_presets, _of_shifts, time_again
from sparsestreet.evaluation.speed import Timing
from sparsestreet.ops import SplatSettings
from sparsestreet.phases import StageRecorder
from sparsestreet.records.costs import COSTS, EffectGain, update_costs
from sparsestreet.records.run import this_machine, this_source
from sparsestreet.records.summary import (
    LATENCY,
    NOVEL,
    PRESETS,
    SUMMARY,
    Evaluation,
    NovelRecord,
    NovelShift,
    PresetRecord,
    RenderedAs,
)
from sparsestreet.scene.rendering import RenderOptions
from tests.evaluation.frames import NOISE, make_frame, make_summary
from tests.evaluation.scenes import OPTIONS, small_scene


def street(count=4, stride=2, **changes):
    """Of so many instants the second and fourth are held out, or none."""
    frames = tuple(make_frame(index) for index in range(count))
    log = DrivingLog("some", as_frames(frames), Sweeps.of(()), (), count, 1, torch.eye(4).double(), **changes)
    return StreetData(log, stride=stride, offset=1)


@pytest.mark.lengthy
@pytest.mark.parametrize(("stride", "views", "ramp"), [(2, 1, True), (0, 3, False)])
def test_the_held_out_views_are_measured_and_the_training_views_where_there_are_none(
    monkeypatch, tmp_path, stride, views, ramp
):
    monkeypatch.setattr(extra, "open_lpips", lambda device: ({}, {"lpips_alex": "no weights"}))
    monkeypatch.setattr(extra, "open_inception", lambda device: (None, {"fid": "no file"}))
    (tmp_path / "records").mkdir()
    said = []
    asked = ExtraMetrics(novel=(1.0,), ramp=ramp, presets=("fast",))
    asked.measure(small_scene(), street(3, stride), OPTIONS, out=tmp_path, command="c", say=said.append)
    beside = NOVEL.read(tmp_path)
    assert (beside.real_views, beside.ramp) == (views, ramp)
    assert PRESETS.read(tmp_path).views == views
    assert f"1 m to the right (n={views}): nothing to compare with" in said
    few = "distances need at least two images: hold out more views"
    expected = {"fid": few, "alexnet": few} if views == 1 else {"fid": "no file", "alexnet": "no weights"}
    alexnet = dict.fromkeys(("frechet_alexnet", "kernel_alexnet"), expected.pop("alexnet"))
    assert beside.missing == expected | alexnet


def test_what_is_said_of_a_side():
    """Offsets are meters to the right, as in the record."""
    shifts = [
        NovelShift(offset=offset, views=6, distances={"fid": 42.0}, truth={"psnr_full": 20.0}, true_views=6)
        for offset in (2.0, -2.0)
    ]
    record = NovelRecord(command="c", ramp=False, real_views=6, absent=None, shifts=tuple(shifts))
    said = [f"2 m to the {side} (n=6): fid 42, 20.00 dB to the truth" for side in ("right", "left")]
    assert list(_of_shifts(record)) == said
    lacking = replace(record, missing={"fid": "no file", "kid": "no file", "frechet_alexnet": "no package"})
    assert list(_of_shifts(lacking)) == [*said, "no fid, kid: no file", "no frechet_alexnet: no package"]


NETWORK = object()


@pytest.mark.parametrize("weights", [{}, {"lpips_alex": NETWORK, "lpips_vgg": object()}])
def test_everything_reaches_the_measurements(monkeypatch, tmp_path, weights):
    asked = {}
    reasons = {"fid": "no weights"}
    novel = NovelRecord(command="n", ramp=True, real_views=2, absent="no weights", missing=reasons, shifts=())
    rendered = PresetRecord(command="p", device="d", threads=1, views=2, noise=NOISE, rendered=())
    for name, answer in (("evaluate_novel", novel), ("evaluate_presets", rendered)):
        monkeypatch.setattr(extra, name, lambda *args, n=name, a=answer, **how: asked.update({n: (args, how)}) or a)
    opened = []
    monkeypatch.setattr(
        extra, "open_lpips", lambda device: opened.append(device) or (weights, {"lpips_alex": "a", "lpips_vgg": "v"})
    )
    monkeypatch.setattr(extra, "LastLayer", lambda *given: ("features", *given))
    inception = [object()] if weights else []
    missing = {} if weights else {"fid": "i", "kid": "i"}
    monkeypatch.setattr(
        extra, "open_inception", lambda device: opened.append(device) or (*(inception or [None]), dict(missing))
    )
    scene, data = small_scene(), street(truth=lambda view: None)
    truth = data.driving_log.truth
    told = ExtraMetrics(novel=(1.0, 2.5), ramp=True, presets=("fast", "fine"))
    said = []
    with StageRecorder() as stages:
        told.measure(scene, data, OPTIONS, out=tmp_path, command="typed", say=said.append)
    views = data.split.held_out
    assert asked["evaluate_novel"] == (
        (scene, views, (1.0, 2.5), OPTIONS),
        {"command": "typed", "truth": truth, "ramp": True, "lpips": NETWORK if weights else None,
         "extractors": [*inception, ("features", "alexnet", NETWORK)] if weights else [],
         "missing": missing | ({} if weights else {"frechet_alexnet": "a", "kernel_alexnet": "a"})},
    )  # fmt: skip
    ways = {name: RenderOptions(SplatSettings.preset(name)) for name in ("fast", "fine")}
    assert asked["evaluate_presets"] == ((scene, views, ways, OPTIONS), {"command": "typed"})
    assert opened == [scene.device] * 2
    assert (NOVEL.read(tmp_path), PRESETS.read(tmp_path)) == (novel, rendered)
    assert said == ["no fid: no weights"]
    assert set(stages.seconds()) == {"other", "novel", "presets"}


def test_nothing_is_measured_where_nothing_is_asked(tmp_path):
    ExtraMetrics().measure(small_scene(), street(), OPTIONS, out=tmp_path, command="c", say=pytest.fail)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("antialias", [False, True])
def test_a_scene_is_drawn_with_antialias_as_it_was_trained_by_others_without(antialias, tmp_path, monkeypatch):
    asked = []
    record = PresetRecord(command="p", device="d", threads=1, views=2, noise=NOISE, rendered=())
    monkeypatch.setattr(extra, "evaluate_presets", lambda scene, views, ways, *_, **__: asked.append(ways) or record)
    options = RenderOptions(SplatSettings(antialias=antialias), "reference")
    told = ExtraMetrics(presets=("default", "exact", "fine", "fast", "inria", "gsplat15", "drivestudio"))
    told.measure(small_scene(), street(), options, out=tmp_path, command="c", say=pytest.fail)
    drawn = {name: way.settings.antialias for name, way in asked[0].items()}
    own = dict.fromkeys(("default", "exact", "fine", "fast"), antialias)
    assert drawn == own | dict.fromkeys(("inria", "gsplat15", "drivestudio"), False)
    assert all(replace(way.settings, antialias=False) == SplatSettings.preset(name) for name, way in asked[0].items())


def test_what_is_said_of_presets():
    ways = [
        RenderedAs(
            preset=name, trained=trained, quality={"psnr_full": psnr}, psnr_to_exact=exact, frame_ms=ms, repeats=3
        )
        for name, trained, psnr, exact, ms in (("fast", False, 24.125, 41.25, 7.75), ("fine", True, 25.5, 52.5, 9.25))
    ]
    record = PresetRecord(command="p", device="d", threads=1, views=2, noise=NOISE, rendered=tuple(ways))
    assert list(_of_presets(record)) == [
        "fast: 24.12 dB, 41.2 dB to the exact image, 7.8 ms/frame",
        "fine (as trained): 25.50 dB, 52.5 dB to the exact image, 9.2 ms/frame",
    ]


def test_metrics_that_cannot_be_are_refused():
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"novel": (1.0, 0.0)}, r"above 0, got \[1.0, 0.0\]"),
        ({"ramp": True}, "say novel=1,2,3 too"),
        ({"presets": ("fast", "quick")}, "no settings preset 'quick'"),
    )
    for asked, said in cases:
        with pytest.raises(ValueError, match=said):
            ExtraMetrics(**asked)


def test_times_are_renewed_and_nothing_else(tmp_path):
    """Of a run with costs; one without gets none, as a record of costs says that a run is whole."""
    before = make_summary(milliseconds=4e5, training_psnr=20.0)
    gain = EffectGain(1.0, None, None, 3)
    whole, part = tmp_path / "whole", tmp_path / "part"
    for run in (whole, part):
        SUMMARY.write(run, before)
    update_costs(whole, phases={"train": 9.0}, frame_ms={"splat": 4e5}, gains={"affine": gain})
    views = street().split.held_out.views
    for run in (whole, part):
        time_again(run, small_scene(), views, OPTIONS, Timing(1, 3, 2), command="typed")
        after = SUMMARY.read(run)
        assert replace(after, latency=before.latency, latency_protocol=before.latency_protocol, timed=None) == before
        assert after.latency.p50 < 4e5
        assert (after.latency.clocks["frame"].repeats, after.latency.warmup, after.latency.views) == (3, 1, 2)
        assert after.latency_protocol == after.latency.protocol
        by = Evaluation("typed", this_machine(), this_source(), after.latency.device, after.latency.threads)
        assert after.timed == after.timing == by
        assert {row.clock: row.percentiles.repeats for row in LATENCY.read(run)} == {"frame": 3, "rig": 3, "raster": 3}
    costs = COSTS.read(whole)
    assert (costs.phases, costs.gains) == ({"train": 9.0}, {"affine": gain})
    assert sum(costs.frame_ms.values()) < 4e5
    assert costs.noise is not None
    assert not COSTS.exists(part)
    assert before.timing == before.evaluated
