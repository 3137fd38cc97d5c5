"""What the guards count as drawn, against what the backends draw."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sparsestreet.ops import Guards, SplatSettings, guards, splat
from sparsestreet.types import Camera, Gaussians
from tests.ops.scenes import (
    cast,
    device_of,
    every_double,
    every_precision,
    front_camera,
    one_gaussian,
    random_gaussians,
)
from tests.ops.test_guards import huge, rows_counted
from tests.ops.test_hard_values import extreme_gaussians
from tests.ops.test_properties import few, scenes, with_effects

CASES = {
    "default": SplatSettings(),
    "antialias, no blur": SplatSettings(antialias=True, stop="exclusive", eps2d=0.0),
    "max_sigma": SplatSettings(max_sigma=1.5, antialias=True, depth_bits=12, half_colors=True),
    "exact": SplatSettings.preset("exact"),
}


def check_against(backend: str, gaussians: Gaussians, view: Camera, settings: SplatSettings) -> Guards:
    counted = guards(gaussians, view, settings=settings)
    assert rows_counted(counted) == len(gaussians)
    drawn = splat(gaussians, view, settings=settings, backend=backend).visible
    assert counted.drawn == int(drawn.sum())
    return counted


@pytest.mark.lengthy
@every_double
@few
@given(scene=scenes, effects=st.booleans(), case=st.sampled_from(sorted(CASES)))
def test_what_is_counted_as_drawn_is_drawn(backend, scene, effects, case):
    gaussians, view, noise = scene
    if effects:
        gaussians, view = with_effects(gaussians, view, noise)
    check_against(backend, gaussians, view, CASES[case])


@pytest.mark.lengthy
@pytest.mark.slow_if_interpreted
@every_precision
@pytest.mark.parametrize("effects", [False, True], ids=["pinhole", "effects"])
def test_a_clean_scene_fires_no_alarm(backend, dtype, effects):
    view = front_camera(64, 48, 50.0)
    gaussians = random_gaussians(400, view, seed=7)
    if effects:
        noise = torch.randn(64, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        gaussians, view = with_effects(gaussians, view, noise)
    gaussians = cast(gaussians, dtype, device=device_of(backend))
    for settings in CASES.values():
        counted = check_against(backend, gaussians, view, settings)
        assert counted.alarms == {}
        # It is no empty scene, and where splats end not all of them are seen.
        assert min(counted.drawn, counted.near) > 10
        assert (counted.outside > 10) == (settings.alpha_min > 0)


@pytest.mark.lengthy
@pytest.mark.slow_if_interpreted
@every_precision
def test_the_hard_scenes(backend, dtype):
    total = Guards()
    for seed in range(20):
        for settings in CASES.values():
            others = one_gaussian(scales=huge(dtype)), one_gaussian(quaternions=[[0.0] * 4])
            scene = Gaussians.concatenate([extreme_gaussians(60, seed), *others])
            scene = cast(scene, dtype, device=device_of(backend))
            # Alpha at the cut-off to the last bit: drawn with radius 0 (Guards.drawn).
            scene.opacities[scene.opacities == torch.tensor(1 / 255, dtype=dtype)] = 0.004
            total += check_against(backend, scene, front_camera(19, 14, 25.0), settings)
    # What such scenes do: no lens, no shutter, no color above 65504.
    unseen = {"past_fold", "outruns_shutter", "sigma_point_held", "color_held"}
    assert {name for name, count in vars(total).items() if count == 0} == unseen
    assert {"vanished", "overflowed", "identity_quaternion"} <= set(total.alarms)
