"""One knob at a time, every preset once, and truths that belong to a point."""

import dataclasses
from dataclasses import replace
from math import inf

import torch

from sparsestreet.bench.knobs import DEFAULT, FIXED, KNOBS, PRESETS, points
from sparsestreet.ops import SplatSettings

POINTS = points()


def test_default_first_and_no_point_twice():
    assert (POINTS[0].knob, POINTS[0].preset) == ("default", "default")
    keys = [(point.settings, point.backend, point.dtype, point.tile, point.effects) for point in POINTS]
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


def test_every_tile_size_at_the_default():
    tiles = [point for point in POINTS if point.tile is not None]
    assert [(point.knob, point.value, point.tile) for point in tiles] == [
        ("tile size", "8", 8),
        ("tile size", "16", 16),
        ("tile size", "32", 32),
    ]
    assert {(point.settings, point.backend, point.dtype) for point in tiles} == {(DEFAULT, "cpu", torch.float32)}


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


def test_what_a_backend_cannot_vary_has_a_reason():
    assert {knob for knob, _ in FIXED} == {"tile size", "exact tiles", "dot precision"}
    assert all(FIXED.values())


def test_both_stops_at_every_transmittance():
    stops = {
        (point.settings.stop, point.settings.transmittance_min)
        for point in POINTS
        if point.settings
        == replace(DEFAULT, stop=point.settings.stop, transmittance_min=point.settings.transmittance_min)
    }
    assert {(stop, least) for stop in ("inclusive", "exclusive") for least in (1e-4, 1e-3, 1e-2)} <= stops


def test_effects_off_and_on():
    seen = [(point.value, point.effects, point.other_model) for point in POINTS if point.effects is not None]
    assert seen == [
        ("off", "off", False),
        ("lens", "lens", True),
        ("shutter", "shutter", True),
        ("lens and shutter", "lens and shutter", True),
    ]
    assert all(point.settings == DEFAULT for point in POINTS if point.effects is not None)
