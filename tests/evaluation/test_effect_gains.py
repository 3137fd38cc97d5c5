"""What an effect brings, against PSNR by its definition."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import as_frames
from sparsestreet.evaluation.evaluate import evaluate_frames
from sparsestreet.evaluation.run import measure_effect_gains
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from tests.cli.toy.gain import Gain, GainSettings
from tests.scene.street import background, random_rows, street_log

OPTIONS = RenderOptions(backend="reference")


def psnr(scene: SceneGraph, frame) -> float:
    image = (render(scene, frame, options=OPTIONS).rgb.clamp(0, 1) * 255).round() / 255
    return -10 * math.log10(float((image - frame.image / 255.0).square().double().mean()))


@pytest.fixture(scope="module")
def scene() -> SceneGraph:
    gain = Gain(GainSettings(evenness=0.1, when="on"), 1)
    torch.nn.init.constant_(gain.log_gains, 0.4)
    off = Gain(GainSettings(evenness=0.1, when="off"), 1)
    return SceneGraph({"road": background(random_rows(40, 0))}, {"gain": gain, "absent": off})


@torch.no_grad()
def test_the_gain_is_a_difference_of_psnr(scene: SceneGraph):
    frames = as_frames(tuple(street_log().frames)[:3])
    whole = list(evaluate_frames(scene, frames, OPTIONS))
    found = measure_effect_gains(scene, frames, whole, OPTIONS)
    without = scene.without("gain")
    expected = sum(psnr(scene, frame) - psnr(without, frame) for frame in frames) / 3
    assert abs(expected) > 0.01  # else the test says nothing
    assert found["gain"].full == pytest.approx(expected, abs=1e-3)  # PSNR of a record is float32
    assert (found["gain"].images, found["gain"].vehicle) == (3, None)
    assert list(found) == ["gain"]  # a stand-in of what is off brings nothing


@torch.no_grad()
def test_regions_are_told_apart(scene: SceneGraph):
    frame = street_log().frames[0]
    mask = torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    mask[: len(mask) // 2] = True
    frames = as_frames((replace(frame, vehicle=mask),))
    found = measure_effect_gains(scene, frames, list(evaluate_frames(scene, frames, OPTIONS)), OPTIONS)["gain"]
    assert found.vehicle is not None
    assert found.human is None
    assert found.vehicle != pytest.approx(found.full, abs=1e-3)
