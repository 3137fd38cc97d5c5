"""One knob at a time, every preset once, and truths that belong to a point."""

import dataclasses
from dataclasses import replace
from math import inf

import pytest
import torch

from sparsestreet.bench import figures, settings_sweep
from sparsestreet.bench.accuracy import answer, errors
from sparsestreet.bench.records import RecordFile, read_records
from sparsestreet.bench.scenes import Size, bench_scenes
from sparsestreet.bench.settings_sweep import DEFAULT, KNOBS, PRESETS, Point, points
from sparsestreet.bench.timing import TimingBudget
from sparsestreet.ops import SplatSettings
from tests.bench.test_records import PROVENANCE
from tests.typed import there

POINTS = points()


def test_default_first_and_no_point_twice():
    assert (POINTS[0].knob, POINTS[0].preset) == ("default", "default")
    keys = [(point.settings, point.backend, point.dtype, point.effects) for point in POINTS]
    assert len(set(keys)) == len(keys)


def test_one_knob_at_a_time():
    for point in POINTS:
        if point.knob in KNOBS:
            off = [
                field.name
                for field in dataclasses.fields(SplatSettings)
                if getattr(point.settings, field.name) != getattr(DEFAULT, field.name)
            ]
            assert off == [point.knob]
            assert point.backend == "cpu"
    for knob, values in KNOBS.items():
        assert getattr(DEFAULT, knob) in values
        assert sum(point.knob == knob for point in POINTS) == len(values) - 1


def test_every_preset_has_one_point():
    named = [(point.preset, point.settings) for point in POINTS if point.preset is not None]
    assert sorted(name for name, _ in named) == sorted(PRESETS)
    for name, settings in named:
        assert settings == SplatSettings.preset(name)


def test_values_are_readable():
    texts = {point.value for point in POINTS}
    assert {"0", "1/1024", "1/64", "3.33", "1e-05", "0.01", "exclusive", "12", "cpu float64"} <= texts


def test_truths_of_a_point():
    by_value = {(point.knob, point.value): point for point in POINTS}
    blurred = by_value["eps2d", "0.1"]
    assert blurred.other_model
    assert blurred.exact.eps2d == 0.1
    assert (blurred.exact.alpha_min, blurred.exact.transmittance_min, blurred.exact.max_sigma) == (0, 0, inf)
    half = by_value["half_colors", "True"]
    assert half.same_cutoffs == DEFAULT
    assert half.exact == SplatSettings.preset("exact")
    assert by_value["depth_bits", "12"].same_cutoffs == DEFAULT
    boxed = by_value["max_sigma", "3"]
    assert boxed.same_cutoffs == boxed.settings
    assert not boxed.other_model
    assert boxed.exact.max_sigma == inf
    assert by_value["backend", "cpu float64"].dtype == torch.float64
    clamped = next(point for point in POINTS if point.preset == "gsplat15")
    assert clamped.other_model
    assert clamped.exact.alpha_max == 0.999


def test_both_stops_at_every_transmittance():
    stops = {
        (point.settings.stop, point.settings.transmittance_min)
        for point in POINTS
        if point.settings
        == replace(DEFAULT, stop=point.settings.stop, transmittance_min=point.settings.transmittance_min)
    }
    assert {(stop, least) for stop in ("inclusive", "exclusive") for least in (1e-4, 1e-3, 1e-2)} <= stops


def test_effects_off_and_on():
    points = [point for point in POINTS if point.effects is not None]
    assert [point.value for point in points] == ["off", "lens", "shutter", "lens and shutter"]
    assert [point.other_model for point in points] == [False, True, True, True]
    assert all((point.effects, point.settings) == (point.value, DEFAULT) for point in points)


pytestmark = pytest.mark.lengthy

ONCE = TimingBudget(repeats=2, seconds=0.0, least=1)
SCENES = bench_scenes(Size(48, 32, 120))
EXACT = SplatSettings.preset("exact")


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    file = RecordFile(tmp_path_factory.mktemp("sweep") / "knobs.jsonl", PROVENANCE)
    said: list[str] = []
    chosen = [
        point for point in points() if point.knob in ("default", "alpha_min", "preset", "eps2d", "effects", "backend")
    ]
    settings_sweep.run_sweep(SCENES, SCENES[:2], chosen, ONCE, file, said.append)
    return read_records(file.path), said, len(chosen)


def test_a_record_for_every_point(swept):
    records, _, count = swept
    assert sum(record["kind"] == "knob" for record in records) == count * len(SCENES)
    assert {record["kind"] for record in records} == {"knob", "small", "oracle"}
    stages = {"forward", "backward", "project", "bin", "blend", "blend_backward", "project_backward"}
    for record in records:
        if record["kind"] == "knob" and record["backend"] == "cpu":
            assert set(record["times"]["stages"]) == stages
            assert record["times"]["pairs"] > 0
            assert record["times"]["samples"] > 0
            assert set(record["exact"]["gradients"]) == {"means", "quaternions", "scales", "opacities", "sh"}


def test_errors_are_against_the_right_truth(swept):
    knobs = [record for record in swept[0] if record["kind"] == "knob" and record["skipped"] is None]
    for record in knobs:
        exact, same = record["exact"]["image"]["psnr"], record["same_cutoffs"]["image"]["psnr"]
        # Rounding alone: float32 against float64 with the same cut-offs. 60 dB leaves room for one sample that rounding
        # moves over a cut-off of 1/64 in one of 1536 pixels.
        assert same is None or same > 60, record["value"]
        assert record["other_model"] or record["model_psnr"] is None
        if record["value"] == "exact":
            assert exact > 110  # float32: 3e-6 of a color
        if (record["knob"], record["value"]) == ("alpha_min", "0"):
            assert exact > 80  # the stop alone: at most transmittance_min = 1e-4 of a color
        if record["knob"] == "eps2d" and record["scene"] == "random frustum":
            # Splats of 2 px: another model is further away than a cut-off.
            assert record["model_psnr"] < exact
    for scene in SCENES:
        by_value = {r["value"]: r["exact"]["image"]["mean"] for r in knobs if r["scene"] == scene.name}
        assert by_value["1/1024"] < by_value["default"] < by_value["1/64"]


def test_effects_have_a_number_beside_off(swept):
    knobs = [record for record in swept[0] if record["kind"] == "knob"]
    for scene in SCENES:
        default = next(r for r in knobs if r["scene"] == scene.name and r["knob"] == "default")
        effects = {r["value"]: r for r in knobs if r["scene"] == scene.name and r["knob"] == "effects"}
        off, lens, shutter, both = (effects[name] for name in ("off", "lens", "shutter", "lens and shutter"))
        assert off["exact"] == default["exact"]  # the same image, timed beside the others
        assert [(r["distortion"] is None, r["shutter"] is None) for r in (off, lens, shutter, both)] == [
            (True, True), (False, True), (True, False), (False, False),
        ]  # fmt: skip
        assert off["model_psnr"] is None
        # They move splats by a pixel or so: far more than rounding, which is past 90 dB, but not another scene.
        assert all(15 < record["model_psnr"] < 75 for record in (lens, shutter, both))
        assert len({record["model_psnr"] for record in (lens, shutter, both)}) == 3
        for record in (lens, shutter, both):
            # The error is against the exact image with the same effect: the cut-offs alone, as for the default.
            assert record["exact"]["image"]["psnr"] > default["exact"]["image"]["psnr"] - 6
            assert record["same_cutoffs"]["image"]["psnr"] > 60
            assert record["times"]["stages"]["project"]["median"] > 0


def test_the_reference_is_timed_on_small_copies_beside_the_rest(swept):
    small = [record for record in swept[0] if record["kind"] == "small"]
    for scene in SCENES[:2]:
        values = [(r["value"], r["skipped"] is None) for r in small if r["scene"] == scene.name]
        device = torch.cuda.is_available()
        assert values == [
            ("default", True), ("cpu float64", True), ("reference float32", True), ("triton float32", device),
        ]  # fmt: skip
        reference = next(r for r in small if r["scene"] == scene.name and r["backend"] == "reference")
        assert reference["times"]["stages"]["forward"]["median"] > 0
        assert reference["times"]["pairs"] is None
        assert reference["same_cutoffs"]["image"]["psnr"] > 60


def test_points_that_cannot_be_had_say_why(swept):
    triton = [record for record in swept[0] if record["kind"] == "knob" and record["backend"] == "triton"]
    if not torch.cuda.is_available():
        assert all(record["skipped"] and record["times"] is None and record["exact"] is None for record in triton)
    assert any(" -- " in line for line in swept[1]) or torch.cuda.is_available()
    large = bench_scenes(Size(640, 512, 2000))[0]
    assert "dense" in there(
        settings_sweep.unavailable(large, Point("backend", "reference", DEFAULT, backend="reference"))
    )
    assert settings_sweep.unavailable(large, Point("default", "default", DEFAULT)) is None


def test_what_nothing_bounds_is_left_out_where_it_does_not_fit(monkeypatch):
    monkeypatch.setattr(settings_sweep, "UNBOUNDED_PAIRS", 120 * 6 - 1)  # 120 rows, six tiles
    scene, truths = SCENES[0], settings_sweep.Truths(SCENES[0])
    default = settings_sweep.measure_point(scene, Point("default", "default", DEFAULT), truths, ONCE)
    assert default.exact is None
    assert default.same_cutoffs is not None
    assert "no exact image" in settings_sweep.describe(default)
    exact = settings_sweep.measure_point(scene, Point("preset", "exact", EXACT), truths, ONCE)
    assert "nothing bounds" in there(exact.skipped)
    monkeypatch.setattr(settings_sweep, "UNBOUNDED_PAIRS", 120 * 6)
    assert settings_sweep.measure_point(scene, Point("preset", "exact", EXACT), truths, ONCE).exact is not None


def test_the_truth_agrees_with_the_dense_reference(swept):
    oracles = [record for record in swept[0] if record["kind"] == "oracle"]
    assert len(oracles) == 2
    for record in oracles:
        assert record["errors"]["image"]["maximum"] < 1e-12
        assert all(group["relative_l2"] < 1e-9 for group in record["errors"]["gradients"].values())


def test_truth_is_computed_once_and_near_changes_it_only_where_rows_are(monkeypatch):
    calls: list[SplatSettings] = []

    def counted(*arguments, **options):
        calls.append(arguments[2])
        return answer(*arguments, **options)

    monkeypatch.setattr(settings_sweep, "answer", counted)
    truths = settings_sweep.Truths(SCENES[0])  # nearest row at 2 m
    assert truths.of(EXACT) is truths.of(EXACT)
    assert truths.of(SplatSettings(near_plane=0.01)) is truths.of(DEFAULT)
    assert truths.of(SplatSettings(near_plane=30.0)) is not truths.of(DEFAULT)
    assert [settings.near_plane for settings in calls] == [0.2, 0.2, 30.0]


def test_gradient_errors_see_a_wrong_gradient():
    truth, value = (answer(SCENES[0].gaussians, SCENES[0].camera, DEFAULT, "cpu", torch.float64) for _ in range(2))
    assert errors(value, truth).gradients["scales"].relative_l2 == 0
    value.gradients["scales"].mul_(1.5)
    found = errors(value, truth)
    assert found.gradients["scales"].relative_l2 == pytest.approx(0.5)
    assert settings_sweep.worst_gradient(found) == pytest.approx(0.5)


def test_figures_are_drawn(swept, tmp_path):
    paths = figures.draw_pareto(swept[0], tmp_path)
    assert sorted(path.name for path in paths) == [
        "pareto_gradient.png",
        "pareto_gradient.svg",
        "pareto_image.png",
        "pareto_image.svg",
    ]
    assert all(path.stat().st_size > 10_000 for path in paths)
