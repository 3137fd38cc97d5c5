"""A step must not wait for its device between the wait of the splat op and its end.

Tensors on the device "meta" have no numbers: whatever would wait for one of them (``item``, a condition, picking by a
mask) is an error there.
"""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sparsestreet.scene.density import DensityStatistics
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.scene.state import SceneState
from sparsestreet.training import losses
from sparsestreet.training.losses import Loss, dynamic_region
from sparsestreet.types import Frame, Rendering
from tests.training.stubs import StubTrainer, background, frame_at, make_system, no_gaussians, rigid

META = torch.device("meta")
SIZE = (16, 32)
LOSSES = [getattr(losses, name) for name in losses.__all__ if name != "Loss"]


@pytest.fixture(autouse=True)
def no_autocast(monkeypatch):
    """Which does not know the device."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())


def splats(rows: int) -> Rendering:
    rgb, radii = torch.empty(*SIZE, 3, device=META, requires_grad=True), torch.empty(rows, device=META)
    return Rendering(rgb, rgb.sum(-1), rgb.sum(-1), radii, torch.empty(rows, 2, device=META))


def scene() -> SceneGraph:
    weights = {"sharp_shape": 1.0, "mask": StaticMaskSettings(1.0)}
    return SceneGraph({"background": background(6, **weights), "rigid": rigid(4, temporal_smooth=1.0, **weights)})


def given() -> tuple[SceneRendering, Frame, SceneGraph]:
    """A rendering and its frame on a device, and the scene there; cameras stay on the host."""
    frame = frame_at(depth=torch.ones(SIZE), sky=torch.zeros(SIZE, dtype=torch.bool))
    known = {name: getattr(frame, name).to(META) for name in ("image", "depth", "sky")}
    placed = scene().to(META)
    spans = {"background": slice(0, 6), "rigid": slice(6, 10)}
    state = SceneState(0.9, 3, training=True)
    parts = {name: node.raw_at(frame, state) for name, node in placed.nodes.items()}
    drawn = splats(10)
    rendering = SceneRendering(drawn.rgb, drawn.alpha, drawn.depth, drawn, spans, parts, no_gaussians(), state)
    return rendering, replace(frame, **known), placed


@pytest.mark.parametrize("loss", LOSSES)
def test_no_loss_waits(loss: Callable[[], Loss], monkeypatch):
    monkeypatch.setattr(dynamic_region, "splat", lambda gaussians, *_, **__: splats(len(gaussians)))
    term = loss()(*given())
    assert term.device == META
    assert term.requires_grad
    term.backward()


def test_no_regularizer_waits():
    rendering, frame, placed = given()
    terms = placed.regularizers(frame, rendering.parts, rendering.drawn, rendering.state)
    assert set(terms) == {"background/sharp_shape", "rigid/sharp_shape", "rigid/temporal_smooth"}
    assert all(term.device == META for term in terms.values())


def test_logging_does_not_wait(monkeypatch):
    rendering, frame, _ = given()
    system = StubTrainer(make_system({"background": background(3)})).system
    logged: dict[str, Any] = {}
    monkeypatch.setattr(system, "log", lambda name, value, **how: logged.update({name: value}))
    monkeypatch.setattr(system, "log_dict", lambda values, **how: logged.update(values))
    for _ in range(3):
        system._log_training(rendering, {"depth": rendering.depth.mean()}, frame)
    tensors = {name: value.device for name, value in logged.items() if isinstance(value, Tensor)}
    assert tensors == {"psnr": META, "train/depth": META}
    assert logged["gaussians"] == 3


def test_density_statistics_do_not_wait():
    statistics = DensityStatistics(10, META, watched=["size"])
    seen = splats(10)
    statistics.add(seen.screen_offsets, seen.radii, *SIZE, {"size": torch.empty(10, device=META)})
    assert statistics.visits.device == META
