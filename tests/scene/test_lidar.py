"""Ranges along rays: against the textbook's median, and against balls and walls whose distances are known by hand."""

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.ops import SplatSettings
from sparsestreet.scene import lidar
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.lidar import Rays, render_ranges
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.standing import StandingScene
from tests.scene.street import background, keyframes, pose, random_rows, rigid, track

OPTIONS = RenderOptions(SplatSettings(antialias=True), "cpu")
SPACING = (0.01, 0.007)


def crooked_pose() -> Tensor:
    """A lidar that is turned about all axes, far from the origin."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = to_matrix(torch.tensor([0.8, 0.1, -0.25, 0.5], dtype=torch.float64))
    matrix[:3, 3] = torch.tensor([31.0, -17.0, 4.0])
    return matrix


def rows_at(means: Tensor, scales: tuple[float, float, float] = (0.2, 0.2, 0.2), **more: Tensor) -> Rows:
    """Opaque Gaussians."""
    count = len(means)
    parameters = {
        "means": means.float(),
        "log_scales": torch.tensor(scales).log().repeat(count, 1),
        "quaternions": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        "opacity_logits": torch.full((count,), 5.0),
        "sh_dc": torch.zeros(count, 1, 3),
        "sh_rest": torch.zeros(count, 3, 3),
    }
    return Rows(parameters, dict(more))


def scene_of(rows: Rows) -> SceneGraph:
    return SceneGraph({"road": background(rows)})


def unit(azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Of degrees: x ahead, y left, z up."""
    azimuth, elevation = azimuth.double().deg2rad(), elevation.double().deg2rad()
    flat = elevation.cos()
    return torch.stack((flat * azimuth.cos(), flat * azimuth.sin(), elevation.sin()), -1)


def in_world(points: Tensor, world_from_lidar: Tensor) -> Tensor:
    return points @ world_from_lidar[:3, :3].T + world_from_lidar[:3, 3]


@pytest.mark.parametrize("standing", [False, True])
def test_a_ray_to_the_middle_of_a_ball_ends_there(standing):
    """All around, on the seams of the views, at their corners, straight up and down; of a scene in a turned world."""
    generator = torch.Generator().manual_seed(5)
    seams = torch.arange(8) * 45.0
    azimuths = torch.cat((seams, seams + 1e-5, 360 * torch.rand(30, generator=generator), torch.tensor([0.0, 77.0])))
    elevations = 178 * torch.rand(len(azimuths), generator=generator) - 89
    elevations[:8] = torch.tensor([-50.0, 50.0, -49.9, 50.1, 0.0, 30.0, 10.0, -20.0])
    elevations[-2:] = torch.tensor([90.0, -90.0])
    expected = torch.linspace(3, 30, len(azimuths), dtype=torch.float64)[torch.randperm(len(azimuths))]
    directions = unit(azimuths, elevations)
    cosines = directions @ directions.T - 2 * torch.eye(len(azimuths))
    apart = (cosines < math.cos(0.25)).all(1)  # no ball in front of another
    assert apart.sum() > 20
    scene = scene_of(rows_at(in_world(directions[apart] * expected[apart, None], crooked_pose())))
    rays = Rays(directions[apart].float(), crooked_pose(), SPACING)
    found = render_ranges(StandingScene.of(scene) if standing else scene, rays, 0.5, OPTIONS)
    torch.testing.assert_close(found.ranges.double(), expected[apart], rtol=0, atol=2e-3)
    assert bool((found.alpha > 0.5).all())
    assert bool(found.returned.all())
    assert found.rows.tolist() == list(range(len(rays.directions)))


def test_views_are_twice_as_fine_as_the_rays_are_apart():
    """In the middle of a view, along both axes; the image is no larger than it must be."""
    beside, above = (math.degrees(one) for one in SPACING)
    directions = unit(torch.tensor([22.5, 22.5, 22.5 + beside]), torch.tensor([0.0, above, 0.0]))
    (part,) = lidar._fan(Rays(directions.float(), crooked_pose(), SPACING))
    steps = (part.positions[1:] - part.positions[:1]).abs()
    torch.testing.assert_close(steps, torch.tensor([[0.0, 2.0], [2.0, 0.0]]).double(), rtol=0, atol=1e-3)
    assert (part.camera.width, part.camera.height) == (6, 6)  # two pixels, and 1.5 on each side, rounded up


def wall_and_box() -> SceneGraph:
    """In the frame of the lidar: a wall at x = 10 m, before it the front of a box at 5 m, 1 m wide and high."""

    def face(x: float, half: float, step: float) -> Tensor:
        along = torch.arange(-half, half + step / 2, step, dtype=torch.float64)
        left, up = (one.flatten() for one in torch.meshgrid(along, along, indexing="ij"))
        return torch.stack((torch.full_like(left, x), left, up), -1)

    points = torch.cat((face(10.0, 3.0, 0.08), face(5.0, 0.5, 0.04)))
    return scene_of(rows_at(points, (0.002, 0.04, 0.04)))


def test_walls_are_where_they_are_and_edges_belong_to_one_of_them():
    """By hand: x / cos(azimuth) cos(elevation). The seam at azimuth 0 goes through both."""
    azimuths, elevations = torch.meshgrid(torch.linspace(-13, 13, 61), torch.linspace(-13, 13, 47), indexing="ij")
    directions = unit(azimuths.flatten(), elevations.flatten())
    found = render_ranges(wall_and_box(), Rays(directions.float(), torch.eye(4).double(), SPACING), 0.0, OPTIONS)
    side = (directions[:, 1:] / directions[:, :1] * 5).abs().amax(1)  # on the plane of the box, meters
    box, wall = 5 / directions[:, 0], 10 / directions[:, 0]
    clear = (side - 0.5).abs() > 0.15
    expected = torch.where(side < 0.5, box, wall)[clear]
    errors = (found.ranges.double()[clear] - expected).abs()
    assert float(errors.max()) < 0.05  # a Gaussian of 4 cm is met beside its middle
    assert float(errors.median()) < 0.015
    of_either = torch.minimum((found.ranges - box).abs(), (found.ranges - wall).abs())
    assert float(of_either.max()) < 0.05  # at the edge too: nothing lies between


def moving_ball(speed: float) -> SceneGraph:
    """A ball on a rigid object that goes from 10 m, at 100 degrees, away along that line in a log of 2 s."""
    ahead = unit(torch.tensor([100.0]), torch.tensor([0.0]))[0]
    at = [pose(0.3, tuple(((11 + speed * (seconds - 1)) * ahead).tolist())) for seconds in (0.0, 2.0)]
    rows = rows_at(torch.zeros(1, 3), (0.5, 0.5, 0.5), instances=torch.zeros(1, dtype=torch.int64))
    return SceneGraph({"cars": rigid(rows, keyframes([track("ball", [0, 1], at)], 2), max_gap=2.0)})


def rolling(seconds: Tensor | None, still: Callable[[float], Tensor] | Tensor) -> Rays:
    """The first and the last ray of a clockwise turn, side by side."""
    directions = unit(torch.tensor([100.0, 100.2]), torch.zeros(2))
    return Rays(directions.float(), still, SPACING, seconds)


def test_each_ray_of_a_rolling_sweep_meets_objects_where_they_are_then():
    """A ball at 20 m/s is at 10 m when a turn begins and at 12 m when it ends."""
    scene, seconds, lidar_pose = moving_ball(20.0), torch.tensor([-0.05, 0.05]), torch.eye(4, dtype=torch.float64)
    # One ray goes 0.2 degrees beside the middle, and a depth is that of the middle: 9 mm.
    found = render_ranges(scene, rolling(seconds, lidar_pose), 0.5, OPTIONS, duration=2.0).ranges
    torch.testing.assert_close(found, torch.tensor([10.0, 12.0]), rtol=0, atol=0.02)
    at_once = render_ranges(scene, rolling(None, lidar_pose), 0.5, OPTIONS).ranges
    torch.testing.assert_close(at_once, torch.tensor([11.0, 11.0]), rtol=0, atol=0.02)


def test_each_ray_of_a_rolling_sweep_starts_where_the_sensor_is_then():
    """The sensor follows the ball at half its speed, so that the ball is at 10.5 and 11.5 m."""
    ahead = unit(torch.tensor([100.0]), torch.tensor([0.0]))[0]

    def follows(seconds: float) -> Tensor:
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, 3] = 10 * seconds * ahead
        return matrix

    seconds = torch.tensor([-0.05, 0.05])
    found = render_ranges(moving_ball(20.0), rolling(seconds, follows), 0.5, OPTIONS, duration=2.0).ranges
    torch.testing.assert_close(found, torch.tensor([10.5, 11.5]), rtol=0, atol=0.02)


def test_nothing_is_met_where_nothing_is():
    rays = Rays(unit(torch.tensor([3.0, 80.0]), torch.tensor([1.0, 90.0])).float(), crooked_pose(), SPACING)
    for rows in (rows_at(torch.zeros(0, 3)), rows_at(torch.zeros(1, 3))):
        found = render_ranges(scene_of(rows), rays, 0.0, OPTIONS)
        assert found.ranges.tolist() == [math.inf, math.inf]
        assert found.alpha.tolist() == [0.0, 0.0]
        assert not found.returned.any()
    none = render_ranges(scene_of(random_rows(3, 0)), Rays(torch.zeros(0, 3), crooked_pose(), SPACING), 0.0, OPTIONS)
    assert none.ranges.shape == none.alpha.shape == (0,)


def test_thin_fog_is_no_surface():
    """Three Gaussians of alpha 0.2 leave 0.51 of the light: alpha says so, and there is no range; a fourth is met."""
    means = torch.tensor([[5.0, 0.1, 0.0], [6.0, 0.1, 0.0], [7.0, 0.1, 0.0], [8.0, 0.1, 0.0]])
    rays = Rays(torch.nn.functional.normalize(means[3:], dim=1), torch.eye(4).double(), SPACING)
    for count, expected, left in ((3, math.inf, 0.8**3), (4, 8.0, 0.8**4)):
        rows = rows_at(means[:count], (2.0, 2.0, 2.0))
        with torch.no_grad():
            rows.opacity_logits.fill_(math.log(0.2 / 0.8))
        found = render_ranges(scene_of(rows), rays, 0.0, OPTIONS)
        assert float(found.ranges) == pytest.approx(expected, abs=0.01)
        assert float(found.alpha) == pytest.approx(1 - left, abs=1e-3)


def test_no_range_is_a_nan():
    """What is broken is an error; what of it is not drawn changes nothing."""
    directions = unit(torch.tensor([0.0]), torch.tensor([0.0])).float()
    rays = Rays(directions, torch.eye(4).double(), SPACING)
    rows = rows_at(torch.tensor([[9.0, 0.0, 0.0], [4.0, 0.0, 0.0]]))
    with torch.no_grad():
        rows.means[1] = torch.nan
    with pytest.raises(ValueError, match="must be finite, but row 1"):
        render_ranges(scene_of(rows), rays, 0.0, OPTIONS)
    nowhere = Rays(directions, torch.full((4, 4), torch.nan).double(), SPACING)
    with pytest.raises(ValueError, match="pose"):
        render_ranges(scene_of(rows_at(torch.ones(1, 3))), nowhere, 0.0, OPTIONS)
    for wrong, message in (
        ({"directions": torch.nan * directions}, "length of a direction must be 1, but ray 0 has nan"),
        ({"directions": 2 * directions}, "length of a direction must be 1, but ray 0 has 2.0"),
        ({"seconds": torch.tensor([torch.inf])}, "seconds must be finite, but ray 0"),
        ({"spacing": (0.4, 0.0)}, r"spacing must lie in \[0.0001, pi\) radians"),
    ):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(rays, **wrong)
    timed = Rays(directions, torch.eye(4).double(), SPACING, torch.zeros(1))
    with pytest.raises(ValueError, match="rays with seconds need those of the log from time 0 to 1, got duration None"):
        render_ranges(scene_of(random_rows(3, 0)), timed, 0.0, OPTIONS)
