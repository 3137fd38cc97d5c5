"""A trained scene rendered in other ways: which image each is, what is compared with what."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import as_frames
from sparsestreet.evaluation import extra as presets_module
from sparsestreet.evaluation.evaluate import evaluate_frames
from sparsestreet.evaluation.extra import ROUNDS, evaluate_presets
from sparsestreet.ops import SplatSettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from tests.evaluation.frames import make_frame
from tests.evaluation.scenes import OPTIONS, node_of, small_scene
from tests.typed import there

SCENE = small_scene()
FRAMES = as_frames((make_frame(0), make_frame(1, size=(11, 7))))
COARSE = RenderOptions(SplatSettings(alpha_min=0.3))


def evaluated(presets, trained=OPTIONS):
    return evaluate_presets(SCENE, FRAMES, presets, trained, command="c")


@pytest.mark.lengthy
def test_each_preset_is_rendered_and_compared():
    """The distance to the exact image in numpy; quality as evaluation says it of that way to render."""
    record = evaluated({"default": RenderOptions(), "coarse": COARSE})
    assert (record.views, [one.trained for one in record.rendered]) == (2, [True, False])
    for one, settings in zip(record.rendered, (SplatSettings(), COARSE.settings), strict=True):
        options = replace(OPTIONS, settings=settings)
        expected = [there(frame.value("psnr", "full")) for frame in evaluate_frames(SCENE, FRAMES, options)]
        assert one.quality["psnr_full"] == pytest.approx(np.mean(expected), rel=1e-12)
        assert "psnr_human" not in one.quality  # these frames have no such mask
        distances = []
        for view in FRAMES.views:
            images = [
                render(SCENE, view, options=replace(OPTIONS, settings=how)).rgb.detach().double().numpy().clip(0, 1)
                for how in (settings, SplatSettings(alpha_min=0.0, transmittance_min=0.0))
            ]
            distances.append(-10 * np.log10(np.mean((images[0] - images[1]) ** 2)))
        assert one.psnr_to_exact == pytest.approx(np.mean(distances), rel=1e-5)
        assert one.frame_ms > 0
        assert one.repeats == 2 * ROUNDS
    assert record.rendered[0].psnr_to_exact > record.rendered[1].psnr_to_exact + 10


def test_exact_keeps_what_a_splat_is():
    """With the low-pass and the clamp that the scene was trained with, the exact image is the trained one's limit."""
    trained = RenderOptions(SplatSettings(eps2d=1.0, alpha_max=0.6, antialias=True), backend="reference")
    exact = RenderOptions(replace(trained.settings, alpha_min=0.0, transmittance_min=0.0))
    assert evaluated({"exact": exact}, trained).rendered[0].psnr_to_exact == 100


def test_exact_goes_on_behind_what_is_all_but_opaque():
    """A white Gaussian behind a dark one that lets 12 % through, by a way that stops a pixel at 30 %."""
    stack = node_of([[0.0, 0.0, 2.0], [0.0, 0.0, 2.5]])
    with torch.no_grad():
        stack.rows.sh_dc[1] = 1.0
    scene, frames = SceneGraph({"road": stack}), as_frames((make_frame(),))
    trained = replace(OPTIONS, settings=SplatSettings(transmittance_min=0.3))
    (rendered,) = evaluate_presets(scene, frames, {"early": trained}, trained, command="c").rendered
    early, late = (
        render(scene, frames.views[0], options=replace(OPTIONS, settings=settings)).rgb.detach().double().clamp(0, 1)
        for settings in (trained.settings, SplatSettings(alpha_min=0.0, transmittance_min=0.0))
    )
    expected = -10 * math.log10((early - late).square().mean())
    assert rendered.psnr_to_exact == pytest.approx(expected, abs=1e-3)  # the exact image knows no end of a splat
    assert expected < 40


def test_what_is_slow_is_timed_once_a_view(monkeypatch):
    monkeypatch.setattr(presets_module, "SLOW_MS", 0.0)
    assert evaluated({"default": RenderOptions()}).rendered[0].repeats == 2


def test_without_presets_there_is_nothing_to_measure():
    with pytest.raises(ValueError, match="at least one preset"):
        evaluated({})
