"""Heights of the ground, by hand: what covers most from above, near the feet of what was recorded."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.scene.edits import ground as module
from sparsestreet.scene.edits.ground import Ground
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Rigid
from tests.scene.street import background, random_rows, rigid

PLACE = (40.0, -25.0)
"""Far from the world's zero."""


def layer(count: int, z: float, sizes: tuple[float, float, float], *, seed: int, reach: float = 0.9, **turned) -> Rows:
    """Gaussians of one kind within 0.9 m of the place; ``sizes`` along their own axes, turned by Euler angles."""
    generator = np.random.default_rng(seed)
    rows = random_rows(count, seed)
    angles, away = generator.uniform(0, 2 * math.pi, count), reach * generator.uniform(0, 1, count)
    x, y, z_, w = Rotation.from_euler("zyx", [turned.get("yaw", 0.0), turned.get("pitch", 0.0), 0.0]).as_quat()
    with torch.no_grad():
        rows.means[:, 0] = torch.from_numpy(PLACE[0] + away * np.cos(angles))
        rows.means[:, 1] = torch.from_numpy(PLACE[1] + away * np.sin(angles))
        rows.means[:, 2] = z + torch.linspace(-0.05, 0.05, count)
        rows.log_scales[:] = torch.tensor(sizes).log()
        rows.quaternions[:] = 3 * torch.tensor([w, x, y, z_])  # of any length
        rows.opacity_logits.fill_(2.0)
    return rows


ROAD = layer(7, -2.0, (0.5, 0.3, 0.02), seed=1, yaw=0.4)
LEAVES = layer(60, 3.0, (0.06, 0.06, 0.06), seed=2)
WALL = layer(60, 0.5, (1.0, 1.0, 0.01), seed=3, pitch=math.pi / 2)
CLOUD = layer(9, -6.0, (2.0, 2.0, 2.0), seed=4)
ROOF = layer(9, 5.0, (1.0, 1.0, 0.02), seed=5, yaw=1.0)


def scene(*layers: Rows, boxes: Rigid | None = None) -> SceneGraph:
    nodes = {f"part_{number}": background(rows) for number, rows in enumerate(layers)}
    return SceneGraph(nodes | ({} if boxes is None else {"boxes": boxes})).eval()


def box_at(x: float, y: float, z: float, height: float = 3.0, pitch: float = 0.2) -> Rigid:
    """A box on a slope whose feet are there, and a moment later, and one of another object that was never there."""
    qx, qy, qz, qw = Rotation.from_euler("y", pitch).as_quat()
    up = Rotation.from_euler("y", pitch).apply([0.0, 0.0, height / 2])
    center = torch.tensor([x, y, z]) + torch.from_numpy(up).float()
    keyframes = Trajectories(
        torch.tensor([[0.0, 1.0], [0.0, 1.0]]),
        torch.tensor([qw, qx, qy, qz]).float().repeat(2, 2, 1),
        torch.stack([torch.stack([center, center]), torch.tensor([PLACE[0], PLACE[1], 90.0]).repeat(2, 1)]),
        torch.tensor([[True, True], [False, False]]),
        torch.tensor([[0.0, 1.0], [2.0, 2.0]]),
    )
    sizes = torch.tensor([[4.0, 2.0, height], [1.0, 1.0, 1.0]])
    return rigid(random_rows(4, 0, instances=torch.tensor([0, 0, 1, 1])), keyframes, sizes)


def test_the_ground_covers_most_of_a_place_seen_from_above():
    """Leaves and a wall are more Gaussians, in layers as thin; guesses below it are large."""
    assert Ground(scene(LEAVES, WALL, ROAD, CLOUD)).below(*PLACE) == pytest.approx(-2.0, abs=0.05)
    assert Ground(scene(LEAVES, WALL, CLOUD)).below(*PLACE) == pytest.approx(3.0, abs=0.1)
    assert Ground(scene(CLOUD)).below(*PLACE) is None
    assert Ground(scene(ROAD)).below(PLACE[0] + 9.5, PLACE[1]) is None


def test_cover_is_the_area_seen_from_above_by_the_opacity():
    rows = random_rows(40, 7)
    with torch.no_grad():
        rows.log_scales[:] += torch.linspace(-2, 3, 40)[:, None]
    means, cover = module._flat(rows)
    w, x, y, z = torch.nn.functional.normalize(rows.quaternions.detach().double(), dim=1).T.numpy()
    turns = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    shapes = turns @ (np.exp(2 * rows.log_scales.detach().double().numpy())[:, :, None] * turns.transpose(0, 2, 1))
    opacities = 1 / (1 + np.exp(-rows.opacity_logits.detach().double().numpy().ravel()))
    flat = np.sqrt(shapes[:, 2, 2]) < 0.3
    assert 5 < flat.sum() < 40
    assert torch.equal(means, rows.means.detach()[torch.from_numpy(flat)])
    np.testing.assert_allclose(cover, (opacities * np.sqrt(np.linalg.det(shapes[:, :2, :2])))[flat], rtol=1e-4)


def test_feet_of_recorded_objects_tell_roofs_from_the_ground():
    """A roof covers more than the road; a box stood 8 m away, up to 1.3 m higher or lower."""
    assert Ground(scene(ROAD, ROOF)).below(*PLACE) == pytest.approx(5.0, abs=0.05)
    for z in (-2.0, -0.8, -3.2):
        near = box_at(PLACE[0] + 8, PLACE[1], z)
        assert Ground(scene(ROAD, ROOF, boxes=near)).below(*PLACE) == pytest.approx(-2.0, abs=0.05)
        assert Ground(scene(ROAD, ROOF, boxes=near)).off(*PLACE, 1.0) == pytest.approx(3.0, abs=0.05)
    far = box_at(PLACE[0] + 21, PLACE[1], -2.0)
    assert Ground(scene(ROAD, ROOF, boxes=far)).below(*PLACE) == pytest.approx(5.0, abs=0.05)


def test_where_nothing_flat_lies_the_ground_is_as_high_as_the_nearest_feet():
    stood = box_at(PLACE[0], PLACE[1] - 11, -7.5)
    assert Ground(scene(ROOF, boxes=stood)).below(*PLACE) == pytest.approx(-7.5, abs=1e-4)
    assert Ground(scene(boxes=stood)).below(*PLACE) == pytest.approx(-7.5, abs=1e-4)
    assert Ground(scene(boxes=stood)).off(PLACE[0] + 30, PLACE[1], 0.0) is None
