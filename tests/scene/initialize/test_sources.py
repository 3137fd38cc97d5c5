import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import Frames, Sweeps, as_frames
from sparsestreet.scene.initialize.gaussians import Points, fit_planes
from sparsestreet.scene.initialize.sources import (
    FarPoints,
    ImagePoints,
    LidarPoints,
    NearPoints,
    PointSource,
    Seeds,
    pixel_sizes,
)
from sparsestreet.scene.initialize.training_data import Coverage, TrainingData
from sparsestreet.triangulation import StreetPoints, TriangulatedPoints
from sparsestreet.types import SparsePoints, Sweep, View
from tests.scene.street import frame_at, rigid_settings, street_log, training_data, triangulated
from tests.typed import there


def drawn(source: PointSource, count: int, data: TrainingData, seed: int = 0) -> Seeds:
    return source.draw(count, data, torch.Generator().manual_seed(seed))


def data_with(points: TriangulatedPoints) -> TrainingData:
    return training_data(points=StreetPoints(points, {}))


Order = Literal["beyond_first", "beyond_only", "random"]


def ten_points() -> TriangulatedPoints:
    """At x = 0 .. 9; the odd ones are seen in the sky, where the lidar has nothing, the even ones on the road."""
    at_row = [3.5 if point % 2 else 18.5 for point in range(10)]
    return triangulated([[float(x), 0.0, 0.0] for x in range(10)], [(x, 0, 16.5, at_row[x]) for x in range(10)])


def data_with_lidar() -> TrainingData:
    """``ten_points``, and returns in the lower half of every image."""
    depth = torch.zeros_like(there(frame_at(0).sky), dtype=torch.float32)
    depth[11:] = 5.0
    log = street_log()
    log = replace(log, frames=as_frames([replace(frame, depth=depth) for frame in log.frames]))
    return training_data(log, points=StreetPoints(ten_points(), {}))


def test_shares_are_those_of_the_pixels():
    seen = Coverage(lidar=0.5, images=0.3)
    sources = [LidarPoints(), ImagePoints(), NearPoints(part=0.25), FarPoints(part=0.75)]
    assert [source.share(seen) for source in sources] == pytest.approx([0.5, 0.3, 0.05, 0.15])


def test_points_beyond_the_lidar_come_first_alone_or_in_their_turn():
    data = data_with_lidar()

    def taken(order: Order, count: int) -> list[int]:
        return drawn(ImagePoints(order=order), count, data).points.positions[:, 0].int().tolist()

    odd = {1, 3, 5, 7, 9}
    first = taken("beyond_first", 8)
    assert set(first[:5]) == odd
    assert len(set(first)) == 8
    assert set(taken("beyond_first", 3)) < odd
    assert set(taken("beyond_only", 8)) == odd
    everything = taken("random", 10)
    assert sorted(everything) == list(range(10))
    assert set(everything[:5]) != odd


def test_which_points_are_taken_is_chance():
    data = data_with_lidar()
    choices = {tuple(drawn(ImagePoints(), 3, data, seed).points.positions[:, 0].tolist()) for seed in range(8)}
    assert len(choices) > 1


def test_points_from_images_bring_limits_by_the_size_of_a_pixel():
    points = triangulated([[1.0, 2.0, 3.0]] * 4, color=(0.1, 0.2, 0.3), pixel_size=0.02)
    seeds = drawn(ImagePoints(smallest_pixels=2.0, largest_pixels=5.0, initial_opacity=0.7), 9, data_with(points))
    assert len(seeds) == 4
    assert seeds.smallest.tolist() == pytest.approx([0.04] * 4)
    assert seeds.largest.tolist() == pytest.approx([0.1] * 4)
    assert seeds.opacities.tolist() == pytest.approx([0.7] * 4)
    torch.testing.assert_close(seeds.points.colors, torch.tensor([[0.1, 0.2, 0.3]] * 4))


@pytest.mark.parametrize("order", ["beyond_first", "random"])
def test_limits_are_of_the_points_that_were_chosen(order: Order):
    """Of ten points a pixel spans 1, 2 ... 10 cm."""
    points = replace(ten_points(), pixel_sizes=0.01 * np.arange(1, 11, dtype=np.float32))
    seeds = drawn(ImagePoints(order=order, smallest_pixels=2.0), 10, data_with(points))
    torch.testing.assert_close(seeds.smallest, 0.02 * (1 + seeds.points.positions[:, 0]))


def test_points_of_the_log_are_points_from_images():
    """Cameras look along z from x = 0, 1, 2, ...; the points lie 10 m ahead of them."""
    positions = torch.tensor([[0.0, 0, 10], [2.0, 0, 20]])
    sparse = SparsePoints(positions, torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]))
    alone = training_data(replace(street_log(), sparse_points=lambda: sparse))
    seeds = drawn(ImagePoints(smallest_pixels=2.0, largest_pixels=5.0), 9, alone)
    assert torch.equal(seeds.points.positions, positions)
    assert torch.equal(seeds.points.colors, sparse.colors)
    sizes = pixel_sizes(positions, alone.views)
    torch.testing.assert_close(seeds.smallest, 2 * sizes)
    torch.testing.assert_close(seeds.largest, 5 * sizes)
    both = replace(alone, image_points=StreetPoints(ten_points(), {}))
    found = drawn(ImagePoints(), 99, both).points.positions
    assert sorted(found.tolist()) == sorted([*positions.tolist(), *([float(x), 0, 0] for x in range(10))])
    choices = {tuple(drawn(ImagePoints(), 3, both, seed).points.positions[:, 2].tolist()) for seed in range(12)}
    assert len({len(choice) for choice in choices}) == 1
    assert len(choices) > 2
    assert len(drawn(ImagePoints(voxel=100.0), 9, alone)) == 1


def test_a_pixel_is_as_large_as_the_nearest_camera_sees_it():
    """Cameras at x = 0 and x = 10, the second with twice the focal length."""
    near, far = training_data().views[0].camera, training_data().views[0].camera
    pose = far.camera_from_world.clone()
    pose[:3, 3] -= pose[:3, :3] @ torch.tensor([10.0, 0, 0])
    zoomed = replace(far, camera_from_world=pose, intrinsics=torch.diag(torch.tensor([2.0, 2, 1])) @ far.intrinsics)
    views = [View(near, 0.0), View(zoomed, 1.0)]
    at = torch.stack((near.position + torch.tensor([0, 0, 4.0]), zoomed.position + torch.tensor([0, 0, 6.0])))
    focal = float(near.intrinsics[0, 0])
    torch.testing.assert_close(pixel_sizes(at, views), torch.tensor([4 / focal, 3 / focal]))


def test_a_run_without_points_from_images_gives_none():
    assert len(drawn(ImagePoints(), 9, training_data())) == 0
    assert len(drawn(ImagePoints(), 9, data_with(triangulated([])))) == 0


@pytest.mark.parametrize("order", ["beyond_first", "random"])
def test_of_the_points_in_a_cube_one_is_taken(order: Order):
    points = triangulated([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.7, 0.1, 0.1]])
    for voxel, count in ((None, 3), (0.5, 2), (1.0, 1)):
        assert len(drawn(ImagePoints(order=order, voxel=voxel), 9, data_with(points))) == count
    # Returns lie on 25 m x 8 m of flat road and in a car: cubes of 1 km hold one of each side of x, y and z = 0.
    returns = len(drawn(LidarPoints(), 10_000, training_data()))
    assert 1 <= len(drawn(LidarPoints(voxel=1000.0), 10_000, training_data())) <= 8 < returns


def test_returns_have_no_limits_but_the_smallest_scale():
    seeds = drawn(LidarPoints(initial_opacity=0.2), 30, training_data())
    assert len(seeds) == 30
    assert seeds.smallest.tolist() == pytest.approx([1e-3] * 30)
    assert set(seeds.largest.tolist()) == {math.inf}
    assert seeds.opacities.tolist() == pytest.approx([0.2] * 30)


@pytest.mark.parametrize(("voxel", "count"), [(None, 10_000), (None, 40), (0.5, 10_000), (0.5, 20)])
def test_returns_know_the_time_of_their_sweep(voxel: float | None, count: int):
    """Those of sweep 3 of 5 were measured at 3/4, whichever of them are taken."""
    data = training_data(held_out=frozenset({1}))
    seeds = drawn(LidarPoints(voxel=voxel), count, data)
    at = {tuple(p): sweep.index / 4 for sweep in data.sweeps for p in sweep.points.tolist()}
    assert seeds.times.tolist() == [at[tuple(p)] for p in seeds.points.positions.tolist()]
    assert len(set(seeds.times.tolist())) == 4


def test_guesses_and_points_from_images_know_no_time():
    for source in (NearPoints(part=1.0), FarPoints(part=1.0), ImagePoints()):
        seeds = drawn(source, 5, data_with(ten_points()))
        assert len(seeds) == 5
        assert seeds.times.isnan().all()


@pytest.mark.parametrize("kind", [NearPoints, FarPoints])
def test_guesses_are_limited_by_the_distance_from_the_nearest_camera(kind: type):
    data = training_data()
    seeds = drawn(kind(part=1.0, largest_scale=0.1, initial_opacity=0.05), 30, data)
    cameras = torch.stack([view.camera.position for view in data.views])
    distance = (seeds.points.positions[:, None] - cameras).norm(dim=2).min(1).values
    torch.testing.assert_close(seeds.largest, 0.1 * distance)
    assert seeds.opacities.tolist() == pytest.approx([0.05] * 30)


def by_hand(positions: torch.Tensor, data: TrainingData) -> torch.Tensor:
    """Which positions some training view has in its image, by the pinhole's formula."""
    seen = torch.zeros(len(positions), dtype=torch.bool)
    for camera in (view.camera for view in data.views):
        x, y, z = (positions @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]).unbind(1)
        column = camera.intrinsics[0, 0] * x / z + camera.intrinsics[0, 2]
        row = camera.intrinsics[1, 1] * y / z + camera.intrinsics[1, 2]
        seen |= (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return seen


@pytest.mark.parametrize("kind", [NearPoints, FarPoints])
def test_blind_guesses_are_all_that_a_training_view_has_in_its_image(kind: type, monkeypatch):
    source, data = kind(part=0.0, largest_scale=None, blind=True), training_data(held_out=frozenset({1}))
    monkeypatch.setattr(Frames, "__getitem__", lambda *_: pytest.fail("an image was decoded"))
    seeds = drawn(source, 2000, data)
    center, generator = data.log.center, torch.Generator().manual_seed(0)
    candidates = source.positions(6000, center, data.log.radius, generator)
    assert torch.equal(seeds.points.positions, candidates[by_hand(candidates, data)])
    distance = (candidates - center).norm(dim=1) / data.log.radius
    if kind is NearPoints:
        # In a ball the cube of the distance is uniform; the standard error of a mean of 6,000 is 0.004.
        assert float((distance**3).mean()) == pytest.approx(0.5, abs=0.02)
    else:
        # u = R / distance: a fiftieth of all is clamped to 0.02, the others are uniform above it.
        u = 1 / distance
        assert float((u < 0.0201).float().mean()) == pytest.approx(0.02, abs=0.006)
        assert float(u[u > 0.0201].mean()) == pytest.approx(0.51, abs=0.02)
    # Uniform colors: mean 1/2, standard deviation 1 / sqrt(12).
    assert float(seeds.points.colors.std()) == pytest.approx(12**-0.5, abs=0.02)
    assert set(seeds.largest.tolist()) == {math.inf}


def test_returns_from_moving_objects_if_no_box_is_cut_out():
    data = training_data(movers=rigid_settings())
    inside = sum(int(sweep.colored.sum()) for sweep in data.sweeps)
    assert len(drawn(LidarPoints(box_enlargement=None), 10_000, data)) == inside
    assert len(drawn(LidarPoints(), 10_000, data)) <= inside - 5 * 60


def seeds_of(*values: float) -> Seeds:
    """Each field has numbers of its own."""
    each = torch.tensor(values)
    across = each[:, None].expand(-1, 3)
    return Seeds(Points(across, across + 10), each + 20, each + 30, each + 40, each + 50, across + 60)


def test_seeds_of_several_sources_follow_each_other():
    both = Seeds.concatenate([seeds_of(1.0, 2.0), seeds_of(3.0)])
    for found, expected in ((both, seeds_of(1.0, 2.0, 3.0)), (both.where(torch.arange(3) > 0), seeds_of(2.0, 3.0))):
        assert len(found) == len(expected)
        for name, value in {**vars(found), **vars(found.points)}.items():
            if name != "points":
                assert torch.equal(value, {**vars(expected), **vars(expected.points)}[name]), name
    assert len(Seeds.concatenate([])) == 0


def road(seed: int = 0) -> torch.Tensor:
    """400 returns of a road that rises by 1 in 10 along x, 2 cm off it; 1 m long and wide."""
    generator = torch.Generator().manual_seed(seed)
    x, y = torch.rand(2, 400, generator=generator)
    return torch.stack((x, y, 0.05 + 0.1 * x + 0.02 * torch.randn(400, generator=generator)), 1)


def log_with_returns(points: torch.Tensor) -> TrainingData:
    sweep = Sweep(0, 0.0, points, torch.full_like(points, 0.5), torch.ones(len(points), dtype=torch.bool))
    return training_data(replace(street_log(), sweeps=Sweeps.of((sweep,)), tracks=()))


def test_returns_of_a_road_lie_in_its_plane_and_know_its_normal():
    hedge = torch.rand(300, 3, generator=torch.Generator().manual_seed(1)) + torch.tensor([0.0, 2.0, 0.0])
    seeds = drawn(LidarPoints(), 10_000, log_with_returns(torch.cat((road(), hedge))))
    flat = seeds.normals.isfinite().all(1)
    assert torch.equal(flat, seeds.points.positions[:, 1] < 1.5)
    normal = torch.tensor([-0.1, 0.0, 1.0]) / 1.01**0.5
    # 100 returns a cube of 0.5 m, 2 cm off: the slope's standard error is 0.02 / sqrt(100) / 0.144 = 0.014.
    assert (seeds.normals[flat] - normal).norm(dim=1).max() < 0.06
    assert torch.allclose(seeds.normals[flat].norm(dim=1), torch.ones(400))
    x, _, z = seeds.points.positions[flat].unbind(1)
    # The plane itself is known to 2 mm at its center and 5 mm at a corner; 2 cm remain without it.
    assert (z - 0.05 - 0.1 * x).abs().max() < 0.02
    assert (z - 0.05 - 0.1 * x).square().mean().sqrt() < 0.005


def test_returns_start_as_balls_if_nothing_is_flattened():
    points = road()
    seeds = drawn(LidarPoints(flat=False), 10_000, log_with_returns(points))
    assert seeds.normals.isnan().all()
    assert torch.equal(seeds.points.positions.sort(0).values, points.sort(0).values)


@pytest.mark.parametrize(
    "points",
    [
        0.4 * road()[:9],  # too few
        torch.linspace(0, 0.4, 50)[:, None] * torch.tensor([[1.0, 0.5, 0.0]]) + 0.05,  # a beam
        torch.rand(400, 3, generator=torch.Generator().manual_seed(0)),  # a hedge
        torch.zeros(50, 3) + 0.25,  # one place
    ],
)
def test_what_is_no_plane_is_left_alone(points: torch.Tensor):
    at, normals = fit_planes(points).onto(points)
    assert normals.isnan().all()
    assert torch.equal(at, points)


def test_a_place_without_returns_has_no_plane():
    planes = fit_planes(road())
    _, normals = planes.onto(
        torch.tensor([[0.25, 0.25, 0.1], [0.25, 0.25, 9.0], [-0.25, 0.25, 0.1], [900.0, 0.0, 0.0]])
    )
    assert normals.isfinite().all(1).tolist() == [True, False, False, False]
    nobody, _ = planes.onto(torch.zeros(0, 3))
    assert len(nobody) == 0


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: LidarPoints(initial_opacity=0.0), "initial_opacity must lie between 0 and 1, got 0.0"),
        (lambda: ImagePoints(initial_opacity=1.0), "initial_opacity must lie between 0 and 1, got 1.0"),
        (lambda: NearPoints(part=0.5, number=-1), "number must be >= 0, got -1"),
        (lambda: LidarPoints(voxel=0.0), "voxel must be larger than 0, got 0.0"),
        (lambda: LidarPoints(box_enlargement=-1.0), "box_enlargement must be larger than 0, got -1.0"),
        (lambda: ImagePoints(voxel=-0.5), "voxel must be larger than 0, got -0.5"),
        (lambda: ImagePoints(smallest_pixels=0.0), "smallest_pixels must be larger than 0, got 0.0"),
        (lambda: ImagePoints(smallest_pixels=9.0), "largest_pixels must be at least smallest_pixels, got 8.0 and 9.0"),
        (lambda: NearPoints(part=-0.1), r"part must lie in \[0, 1\], got -0.1"),
        (lambda: FarPoints(part=1.1), r"part must lie in \[0, 1\], got 1.1"),
        (lambda: FarPoints(part=0.5, largest_scale=0.0), "largest_scale must be larger than 0, got 0.0"),
    ],
)
def test_settings_that_cannot_be(make, said: str):
    with pytest.raises(ValueError, match=said):
        make()
