"""Scenes far from the origin (docs/stability.md; the number in a name is the row there)."""

import dataclasses

import pytest
import torch

from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.reference import projection
from sparsestreet.types import Camera, Gaussians, Shutter
from tests.ops.scenes import (
    FIELDS,
    cast,
    every_backend,
    every_precision,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    render,
)

# Meters from the origin: a drive, the edge of what DrivingLog takes, and a map's easting and northing.
far_away = pytest.mark.parametrize(
    "offset",
    [
        pytest.param((1.7e3, -1e3, 40.0), id="2 km", marks=pytest.mark.slow_if_interpreted),
        pytest.param((17e3, -1e4, 100.0), id="20 km", marks=pytest.mark.slow_if_interpreted),
        pytest.param((4.5e5, 5.4e6, 100.0), id="map"),
    ],
)


def _camera_at(position: torch.Tensor, width: int, height: int) -> Camera:
    """Turned, with a focal length of 1000 px, its pose in float64."""
    turn = to_matrix(torch.tensor([0.9, 0.2, -0.3, 0.1], dtype=torch.float64))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ position
    return Camera(pose, front_camera(width, height, 1000.0).intrinsics, width, height)


@every_precision
@far_away
def test_19_a_splat_far_from_the_origin(backend, dtype, offset):
    # The camera is put 10 m before the float32 mean, which then lies at pixel (21, 22) exactly.
    mean = torch.tensor(offset, dtype=torch.float32).double()
    in_camera = torch.tensor([0.01, 0.02, 10.0], dtype=torch.float64)
    turn = _camera_at(mean, 40, 40).camera_from_world[:3, :3]
    view = _camera_at(mean - turn.T @ in_camera, 40, 40)
    ball = one_gaussian(means=[mean.tolist()], scales=[[0.03] * 3])
    alpha = render(ball, view, backend, dtype, SplatSettings.preset("exact")).images["alpha"]
    places = torch.arange(40, dtype=torch.float64) + 0.5
    center = torch.stack((alpha.sum(0) @ places, alpha.sum(1) @ places)) / alpha.sum()
    # R m + t is off by 0.002, 0.02 and 2 px here in float32.
    error = (center - torch.tensor([21.0, 22.0])).abs().max()
    assert error < (1e-4 if dtype == torch.float32 else 1e-6)


@far_away
def test_19_projected_means(offset):
    position = torch.tensor(offset, dtype=torch.float64) + 0.123456789
    view = _camera_at(position, 64, 48)
    generator = torch.Generator().manual_seed(0)
    slopes = (torch.rand(500, 2, generator=generator, dtype=torch.float64) - 0.5) * torch.tensor([1.0, 0.8])
    depths = 2 + 300 * torch.rand(500, 1, generator=generator, dtype=torch.float64)
    in_camera = torch.cat((slopes, torch.ones_like(depths)), -1) * depths
    means = (in_camera @ view.camera_from_world[:3, :3] + position).float()
    places = []
    for dtype in (torch.float32, torch.float64):
        rows = cast(Gaussians.concatenate([one_gaussian(means=[mean]) for mean in means.tolist()]), dtype)
        seen = (projection.to_camera(rows.means, view)[:, 2] > 1).nonzero()[:, 0]
        places.append(projection.on_screen(rows, seen, view, SplatSettings()).means.double())
    assert len(places[0]) == len(places[1]) > 400
    # 500 px off the middle a float32 has a spacing of 6e-5 px, and the distance from the origin does not matter: found
    # 1.5e-4 px. R m + t is off by up to 0.1, 1 and 300 px.
    assert (places[0] - places[1]).abs().max() < 3e-4


@every_backend
@far_away
@pytest.mark.parametrize("effects", first_interpreted(True, False), ids=["effects", "plain"])
def test_19_a_scene_far_from_the_origin(backend, offset, effects):
    position = torch.tensor(offset, dtype=torch.float64) + 0.123456789
    view = _camera_at(position, 21, 17)
    if effects:
        lens = torch.tensor([-0.2, 0.05, 1e-3, -1e-3, 0.0], dtype=torch.float64)
        view = dataclasses.replace(view, distortion=lens, shutter=Shutter(0.1 * lens[:3], 0.01 * lens[2:]))
    scene = random_gaussians(20, view, terms=16)
    scene = dataclasses.replace(scene, scales=scene.scales + 0.3)
    exact = SplatSettings.preset("exact")
    truth = render(scene, view, "reference", torch.float64, exact)
    result = render(scene, view, backend, torch.float32, exact)
    assert (truth.images["alpha"] > 0.5).any()
    # As near as at the origin: found 3e-7 (depth, in meters, 1e-6) and 1e-5.
    for name, image in truth.images.items():
        assert (result.images[name] - image).abs().max() < 3e-6, name
    for name in FIELDS:
        assert relative_error(result.gradients[name], truth.gradients[name]) < 4e-5, name
