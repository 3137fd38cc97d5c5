"""Opacities for viewers that do not antialias."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.export.plain import MAX_CAMERAS, plain_factors, spread_cameras
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.types import Camera, Gaussians, View

MIP = SplatSettings(antialias=True)


def ahead(distance: float, *, focal: float = 40.0) -> Camera:
    """Looks along z from so far before the origin."""
    pose = torch.eye(4)
    pose[2, 3] = distance
    intrinsics = torch.tensor([[focal, 0.0, 20.3], [0.0, focal, 16.8], [0.0, 0.0, 1.0]])
    return Camera(pose, intrinsics, 41, 33)


def some(*, behind: bool = False) -> Gaussians:
    """Three of other sizes side by side, that do not overlap; the last one may lie behind all cameras."""
    means = torch.tensor([[-2.0, 0.0, 0.0], [0.3, 0.4, 0.1], [2.0, -0.5, -900.0 if behind else 0.2]])
    scales = torch.tensor([[0.02, 0.03, 0.02], [0.1, 0.04, 0.2], [0.3, 0.2, 0.25]])
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.8, 0.0, 0.6, 0.0], [0.6, 0.0, 0.0, 0.8]])
    sh = torch.zeros(3, 1, 3)
    sh[:, 0] = torch.tensor([[0.9, 0.1, 0.5], [0.3, 1.2, 0.2], [0.6, 0.6, 1.4]])
    return Gaussians(means, turns, scales, torch.tensor([0.9, 0.7, 0.5]), sh)


def test_one_camera_then_sees_without_antialias_what_it_sees_with_it():
    gaussians, camera = some(), ahead(10.0)
    factors = plain_factors([(gaussians, [camera])], MIP)
    assert factors[0] < 0.1 < factors[1] < 0.5 < factors[2] < 1
    wanted = splat(gaussians, camera, settings=MIP).rgb
    baked = replace(gaussians, opacities=gaussians.opacities * factors)
    # float32, of colors up to 1; without factors the images differ by 0.3.
    torch.testing.assert_close(splat(baked, camera, settings=SplatSettings()).rgb, wanted, rtol=0, atol=1e-5)
    assert (splat(gaussians, camera, settings=SplatSettings()).rgb - wanted).abs().max() > 0.1


def test_several_cameras_count_alike_and_whom_none_sees_keeps_its_opacity():
    near, far, gaussians = ahead(4.0), ahead(30.0), some(behind=True)
    moved = replace(gaussians, means=gaussians.means + torch.tensor([0.0, 0.0, 3.0]))
    looks = [(gaussians, near), (gaussians, far), (moved, far)]
    alone = [plain_factors([(one, [camera])], MIP) for one, camera in looks]
    both = plain_factors([(gaussians, [near, far]), (moved, [far])], MIP)
    torch.testing.assert_close(both[:2], torch.stack(alone).mean(0)[:2])
    assert alone[0][0] > 2 * alone[1][0]
    assert both[2] == 1


def test_without_antialias_nothing_changes():
    assert plain_factors([(some(), [ahead(10.0)])], SplatSettings()) == 1


@pytest.mark.parametrize("count", [1, 36, 100])
def test_cameras_are_spread_over_all_views(count):
    views = [View(ahead(float(place)), 0.0) for place in range(count)]
    places = [float(camera.camera_from_world[2, 3]) for camera in spread_cameras(views)]
    assert len(places) == min(count, MAX_CAMERAS)
    assert (places[0], places[-1]) == (0.0, float(count - 1))
