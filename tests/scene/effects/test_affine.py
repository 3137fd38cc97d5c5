"""The affine map of colors, against the network that it stands for, and against rows that are really removed."""

import pytest
import torch
from torch import nn

from sparsestreet.scene.effects import Affine, AffineSettings, linearized
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, SceneRendering, render
from sparsestreet.scene.state import FINISHED
from sparsestreet.training.optimizer import OptimizerSettings
from sparsestreet.types import View
from tests.scene.effects.test_effects import CAMERA, sky
from tests.scene.street import background, random_rows

VIEW = View(CAMERA, 0.5, 0, 0)
MIXING = torch.tensor([[0.2, -0.1, 0.05, 0.02], [0.0, 0.3, 0.1, -0.03], [0.1, 0.0, -0.2, 0.04]])


def affine(deltas: torch.Tensor, **said) -> Affine:
    made = Affine(AffineSettings(when="on", **said))
    with torch.no_grad():
        made.deltas.copy_(deltas)
    return made


def scene_of(*leave_out: int, **effects) -> SceneGraph:
    node = background(random_rows(9, 0))
    rows = node.rows
    if leave_out:
        kept = torch.tensor([row for row in range(9) if row not in leave_out])
        rows.resize(RowPlan(len(rows), kept, torch.zeros(len(kept), dtype=torch.bool)))
    return SceneGraph({"road": node}, effects)


def seen(scene: SceneGraph) -> SceneRendering:
    with torch.no_grad():
        return render(scene, VIEW, options=RenderOptions(backend="reference"))


def test_it_maps_the_colors_of_every_pixel():
    plain, mapped = seen(scene_of(sky=sky())), seen(scene_of(sky=sky(), affine=affine(MIXING)))
    for pixel in ((0, 0), (5, 8), (10, 3)):
        wanted = (torch.eye(3) + MIXING[:, :3]) @ plain.rgb[pixel] + MIXING[:, 3]
        torch.testing.assert_close(mapped.rgb[pixel], wanted)
    assert torch.equal(seen(scene_of(affine=Affine())).rgb, seen(scene_of()).rgb)


def test_it_learns_what_drivestudios_network_for_each_image_learns():
    """A row of 4 numbers an image, and layers of 4, 64 and 12, all zero; Adam with its weight decay."""
    images = torch.randn(3, 20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    truth = 0.9 * images + torch.tensor([0.1, 0.0, -0.2])
    rows = nn.Embedding(3, 4, dtype=torch.float64)
    network = nn.Sequential(nn.Linear(4, 64), nn.ReLU(), nn.Linear(64, 12)).double()
    theirs, ours = [*rows.parameters(), *network.parameters()], affine(torch.zeros(3, 4)).double()
    for parameter in theirs:
        nn.init.zeros_(parameter)
    their_adam = torch.optim.Adam(theirs, lr=0.01, eps=1e-15, weight_decay=0.5)
    settings = AffineSettings(when="on", decay=0.5, weight=0.3, learning_rates={"deltas": {"initial": 0.01}})
    ours.settings = settings
    our_adam = OptimizerSettings().build(scene_of(affine=ours), 1.0)
    splats = seen(scene_of()).splats
    for step in range(60):
        image = step % 3
        deltas = network(rows(torch.tensor(image))).view(3, 4)
        away = deltas[:, :3].abs().mean() + deltas[:, 3].abs().mean()
        mapped = images[image] @ (torch.eye(3, dtype=torch.float64) + deltas[:, :3]).T + deltas[:, 3]
        their_adam.zero_grad()
        ((mapped - truth[image]).abs().mean() + 0.3 * away).backward()
        their_adam.step()
        our_adam.zero_grad()
        mapped = ours.image(images[image][None], splats, VIEW, RenderOptions())[0]
        ((mapped - truth[image]).abs().mean() + sum(ours.regularizers(VIEW, FINISHED).values())).backward()
        our_adam.step()
    torch.testing.assert_close(ours.deltas, theirs[-1].view(3, 4), rtol=1e-9, atol=1e-12)
    assert float(ours.deltas.detach().abs().max()) > 0.05
    assert not any(parameter.any() for parameter in theirs[:-1])


@pytest.mark.parametrize("mixed", [False, True], ids=["turned colors", "mixed colors"])
@pytest.mark.parametrize("row", range(3))
def test_changes_without_a_row_are_as_large_as_its_slope_says(row: int, mixed: bool):
    """By removing the row: exact where A scales all colors alike, else within its singular values."""
    turned = 1.3 * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]) - torch.eye(3)
    deltas = MIXING if mixed else torch.cat((turned, MIXING[:, 3:]), 1)
    effects = {"sky": sky(), "affine": affine(deltas)}
    with torch.no_grad():
        both, alone = seen(scene_of(**effects)), seen(scene_of(row, **effects))
        light = linearized(effects.values(), VIEW)
        d_rgb, d_alpha = both.splats.rgb - alone.splats.rgb, both.alpha - alone.alpha
        predicted = light.slope.square() * (d_rgb - light.background * d_alpha[..., None]).square().sum(-1)
        actual = (both.rgb - alone.rgb).square().sum(-1)
    assert float(actual.sum()) > 1e-3
    if not mixed:
        torch.testing.assert_close(actual, predicted, rtol=1e-4, atol=1e-9)
        return
    singular = torch.linalg.svdvals(torch.eye(3) + deltas[:, :3])
    ratio = float((actual.sum() / predicted.sum()).sqrt())
    mean = float(singular.square().mean().sqrt())
    assert float(singular.min()) / mean <= ratio <= float(singular.max()) / mean


def test_terms_without_a_weight_are_not_computed():
    assert affine(MIXING, weight=0.0, decay=0.0).regularizers(VIEW, FINISHED) == {}
    assert affine(MIXING, decay=0.0).regularizers(VIEW, FINISHED).keys() == {"identity"}
