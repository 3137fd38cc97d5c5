"""Planted truth in a hand-made scene: an opaque wall of tiles before a slab, seen by several cameras."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from sparsestreet.geometry.quaternions import from_rotation_vector, to_matrix
from sparsestreet.ops import splat
from sparsestreet.pruning import Floors, keep_by_importance
from sparsestreet.scene.gaussians import Rows
from sparsestreet.types import Camera
from tests.pruning.planted import NOTICEABLE, Views, activated, joint_change, judge, plant
from tests.pruning.test_importance import scores
from tests.scene.street import static_mask

pytestmark = pytest.mark.lengthy

BACKEND = "reference"
RECALL, VISIBLE_LOST = 0.95, 0.02


def wall(generator: torch.Generator) -> Rows:
    """8 x 6 tiles of 0.4 m before three layers of a dark opaque slab at 5 m (meters, z forward)."""
    x, y = torch.meshgrid(torch.arange(8) * 0.4 - 1.4, torch.arange(6) * 0.4 - 1.0, indexing="ij")
    tiles = torch.stack((x, y, torch.full_like(x, 5.0)), dim=-1).reshape(-1, 3)
    slab = torch.tensor([[0.0, 0.0, 5.2], [0.0, 0.0, 5.3], [0.0, 0.0, 5.4]])
    means = torch.cat((tiles, slab))
    scales = torch.cat(
        (torch.tensor([[0.16, 0.16, 0.02]]).expand(len(tiles), 3), torch.tensor([[30.0, 30.0, 0.01]]).expand(3, 3))
    )
    sh_dc = torch.cat((torch.rand(len(tiles), 1, 3, generator=generator) * 3 - 1.5, torch.full((3, 1, 3), -1.24)))
    opacities = torch.cat((torch.full((len(tiles),), 0.95), torch.full((3,), 0.98)))
    quaternions = torch.zeros(len(means), 4)
    quaternions[:, 0] = 1
    return Rows(
        {
            "means": means,
            "log_scales": scales.log(),
            "quaternions": quaternions,
            "opacity_logits": opacities.logit(),
            "sh_dc": sh_dc,
            "sh_rest": torch.zeros(len(means), 0, 3),
            "mask_logits": torch.ones(len(means)),
        },
        transient=["mask_logits"],
    )


def cameras() -> list[Camera]:
    """Three cameras, turned a little, the last one nearer."""
    intrinsics = torch.tensor([[40.0, 0.0, 23.5], [0.0, 40.0, 17.5], [0.0, 0.0, 1.0]])
    views = []
    for x, z, yaw in ((-1.0, 0.0, 0.15), (1.0, 0.0, -0.2), (0.3, 1.5, 0.05)):
        camera_from_world = torch.eye(4)
        rotation = to_matrix(from_rotation_vector(torch.tensor([0.0, yaw, 0.0]))).T
        camera_from_world[:3, :3] = rotation
        camera_from_world[:3, 3] = -rotation @ torch.tensor([x, 0.0, z])
        views.append(Camera(camera_from_world, intrinsics, 47, 35))
    return views


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Hundreds of tiny renderings: on a busy machine threads would mostly wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def planted_wall() -> tuple[Rows, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return plant(wall(generator), cameras(), generator, hidden=40, copies=10, backend=BACKEND)


def test_planted_rows_are_useless_and_keep_the_others(planted_wall):
    rows, planted = planted_wall
    original = wall(torch.Generator().manual_seed(0))
    assert int(planted.sum()) == 50
    assert torch.equal(rows.means[~planted], original.means)
    views = Views(activated(rows), cameras(), BACKEND)
    assert not views.visible(torch.nonzero(planted).squeeze(-1)).any()
    # All fifty at once: each alone moves less than one step, those before the same pixel add up.
    assert joint_change(rows, planted, cameras(), BACKEND) < 3 * NOTICEABLE


def test_zero_importance_removes_what_was_planted_and_nothing_visible(planted_wall):
    rows, planted = planted_wall
    visible = Views(activated(rows), cameras(), BACKEND).visible(torch.nonzero(~planted).squeeze(-1))
    found = scores(Views(activated(rows), cameras(), BACKEND).contributions)
    verdict = judge(keep_by_importance(found, Floors(0)).keep, planted, visible)
    assert verdict.num_visible == 49  # every tile and the front of the slab
    assert verdict.recall >= RECALL
    assert verdict.visible_lost <= VISIBLE_LOST


def test_trained_masks_remove_what_was_planted_and_nothing_visible(planted_wall):
    """The paper's loss on noisy images of the wall, with nothing trained but the masks."""
    rows, planted = planted_wall
    views = Views(activated(rows), cameras(), BACKEND)
    visible = views.visible(torch.nonzero(~planted).squeeze(-1))
    generator = torch.Generator().manual_seed(1)
    mask = static_mask(sparsity_weight=2.5e-3)
    learned = Rows(mask.initial_columns(len(rows)))
    # Ten times the learning rate of a real run: unseen rows cross the threshold after about 141 steps, not 1410.
    adam = torch.optim.Adam(learned.parameters(), lr=0.1, eps=1e-15)
    everything = torch.ones(len(rows), dtype=torch.bool)
    for step in range(160):
        index = step % len(views.cameras)
        multipliers = mask.multipliers(learned, 0.0)
        gaussians = views.gaussians
        masked = replace(
            gaussians, opacities=gaussians.opacities * multipliers, scales=gaussians.scales * multipliers[:, None]
        )
        image = splat(masked, views.cameras[index], backend="cpu").rgb
        noise = 0.02 * torch.randn(image.shape, generator=generator)
        sparsity = mask.sparsity_weight * mask.sparsity(learned, 0.0, everything) / len(rows)
        loss = (image - views.images[index] - noise).abs().mean() + sparsity
        adam.zero_grad()
        loss.backward()
        adam.step()
    verdict = judge(mask.keep(learned).keep, planted, visible)
    assert verdict.recall >= RECALL
    assert verdict.visible_lost <= VISIBLE_LOST


def test_without_the_gate_most_of_them_stay(planted_wall):
    """The test above can fail: touching one pixel faintly is enough to score."""
    rows, planted = planted_wall
    found = scores(Views(activated(rows), cameras(), BACKEND).contributions, gate=False)
    keep = keep_by_importance(found, Floors(0)).keep
    assert float((planted & ~keep).sum()) / 50 < RECALL


def test_a_transparent_scene_hides_nothing():
    rows = wall(torch.Generator().manual_seed(0))
    with torch.no_grad():
        rows.opacity_logits.fill_(-2.0)
    with pytest.raises(ValueError, match="no opaque pixel"):
        plant(rows, cameras(), torch.Generator().manual_seed(0), hidden=3, copies=0, backend=BACKEND)
