"""Who looks at a scene without ``render`` looks through its effects too: here, bent cameras as pinholes."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from sparsestreet.pruning import LeaveOneOutRule, RenderContext
from sparsestreet.pruning.select import contributions
from sparsestreet.scene.effects import LensSettings, Sky, SkySettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, project_centers, render
from sparsestreet.scene.state import FINISHED
from sparsestreet.training.losses import DynamicRegion
from sparsestreet.types import Frame
from tests.training.stubs import background, frame_at, rigid

OPTIONS = RenderOptions(backend="reference")
CONTEXT = RenderContext(options=OPTIONS)
NODES = {"background": background(30), "cars": rigid(30)}
SKY = Sky(SkySettings(resolution=4))
torch.nn.init.uniform_(SKY.texels, generator=torch.Generator().manual_seed(2))
FLAT = frame_at(1)
BENT = replace(FLAT, camera=replace(FLAT.camera, distortion=torch.tensor([-0.3, 0.1, 0.0, 0.0, 0.0])))


def weights(scene: SceneGraph, frame: Frame) -> torch.Tensor:
    ((seen, _),) = contributions(scene, [frame], CONTEXT)
    return seen.weight


def costs(scene: SceneGraph, frame: Frame) -> torch.Tensor:
    return LeaveOneOutRule(0.1).costs(scene, [frame], CONTEXT)["background"]


def region(scene: SceneGraph, frame: Frame) -> torch.Tensor:
    return DynamicRegion(threshold=0.3)(render(scene, frame, FINISHED, OPTIONS), frame, scene)


@pytest.mark.parametrize("look", [weights, costs, region, project_centers])
@torch.no_grad()
def test_a_lens_that_is_left_out_is_seen_by_nobody(look: Callable[[SceneGraph, Frame], torch.Tensor]):
    effects = {"sky": SKY, "lens": LensSettings(when="off").left_out()}
    bare, pinhole = SceneGraph(NODES, {"sky": SKY}), SceneGraph(NODES, effects)
    assert torch.equal(look(pinhole, BENT), look(bare, FLAT))
    assert not torch.equal(look(bare, BENT), look(bare, FLAT))
