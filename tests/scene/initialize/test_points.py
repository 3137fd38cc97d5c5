from dataclasses import replace

import torch

from sparsestreet.geometry.cameras import project
from sparsestreet.scene.initialize.gaussians import Points, thinned
from sparsestreet.scene.initialize.sources import FarPoints, NearPoints, random_points, seen_points
from tests.scene.street import frame_at
from tests.typed import there

CENTER = torch.tensor([1.0, -2.0, 3.0])
near_positions, far_positions = NearPoints(part=1.0).positions, FarPoints(part=1.0).positions


def test_near_points_fill_the_ball_evenly():
    distance = (near_positions(4000, CENTER, 10.0, torch.Generator().manual_seed(0)) - CENTER).norm(dim=1)
    assert distance.max() <= 10.0 * (1 + 1e-5)
    # Half the volume lies within radius / 2^(1/3); 4,000 draws: standard deviation 0.008.
    assert abs((distance < 10.0 / 2 ** (1 / 3)).float().mean() - 0.5) < 0.04


def test_far_points_lie_between_1_and_50_radii():
    distance = (far_positions(4000, CENTER, 10.0, torch.Generator().manual_seed(0)) - CENTER).norm(dim=1)
    assert distance.min() >= 10.0 * (1 - 1e-5)
    assert distance.max() <= 500.0 * (1 + 1e-5)
    # u uniform on [0.02, 1]: half the points have u > 0.51.
    assert abs((distance < 10.0 / 0.51).float().mean() - 0.5) < 0.04


def test_seen_points_are_in_a_view_with_its_color_and_not_in_the_sky():
    frames = [frame_at(0), frame_at(4)]
    positions = near_positions(3000, CENTER, 20.0, torch.Generator().manual_seed(1))
    seen = seen_points(positions, frames)
    assert 0 < len(seen) < 3000
    for position, color in zip(seen.positions, seen.colors, strict=True):
        views = [(frame, *project(frame.camera, position[None])) for frame in frames]
        frame, pixel = next((frame, pixels[0]) for frame, pixels, _, inside in views if inside[0])
        column, row = pixel.long().tolist()
        assert not frame.sky[row, column]
        assert torch.equal(color, frame.image[row, column] / 255)
    in_some_view = torch.stack([project(frame.camera, positions)[2] for frame in frames]).any(0)
    in_sky = torch.tensor([p.tolist() not in seen.positions.tolist() for p in positions[in_some_view]])
    assert in_sky.any()


def test_without_sky_masks_every_position_in_view_is_kept():
    frame = frame_at(0)
    unmasked = type(frame)(frame.camera, 0.0, 0, 0, image=frame.image)
    positions = near_positions(500, CENTER, 20.0, torch.Generator().manual_seed(1))
    assert len(seen_points(positions, [unmasked])) == int(project(frame.camera, positions)[2].sum())


def test_a_position_that_the_recording_car_hides_is_left_to_other_views():
    near, other = frame_at(0), frame_at(4)
    hood = torch.zeros_like(there(near.sky))
    hood[near.camera.height // 2 :] = True
    positions = near_positions(3000, CENTER, 20.0, torch.Generator().manual_seed(1))
    pixels, _, inside = project(near.camera, positions)
    hidden = positions[inside & (pixels[:, 1] >= near.camera.height // 2)]
    assert len(hidden)
    masked = replace(near, ego=hood)
    assert not len(seen_points(hidden, [masked]))
    assert len(seen_points(hidden, [masked, other])) == len(seen_points(hidden, [other])) > 0


def test_samples_are_distinct_points_with_their_colors():
    points = Points(torch.arange(30.0).reshape(10, 3), torch.arange(30.0).reshape(10, 3) / 30)
    sample = points.sampled(4, torch.Generator().manual_seed(0))
    assert len(set(sample.positions[:, 0].tolist())) == 4
    assert torch.equal(sample.positions / 30, sample.colors)
    assert len(points.sampled(99, torch.Generator())) == 10
    assert len(Points.concatenate([])) == 0


def test_one_point_of_each_cube_is_left_whichever_it_is():
    # Cubes of half a meter: the second and third point share one; -0.1 and 0.1 lie on both sides of a face.
    positions = torch.tensor([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.4, 0.49, 0.2], [0.1, 0.5, 0.0]])
    kept = [thinned(positions, 0.5, torch.Generator().manual_seed(seed)).tolist() for seed in range(20)]
    assert {frozenset(rows) for rows in kept} == {frozenset({0, 1, 3}), frozenset({0, 2, 3})}
    assert all(len(rows) == 3 for rows in kept)
    assert {rows[0] for rows in kept} == {0, 1, 2, 3}  # in random order
    assert thinned(torch.zeros(0, 3), 0.5, torch.Generator()).tolist() == []


def test_random_points_come_from_all_views_in_the_colors_of_each():
    """Two cameras back to back: neither sees what the other does."""
    ahead = frame_at(0)
    turned = ahead.camera.camera_from_world.clone()
    turned[[0, 2]] *= -1  # x to the left, z backward
    backward = replace(ahead, camera=replace(ahead.camera, camera_from_world=turned), image=255 - ahead.image)
    frames = [ahead, backward]
    center = ahead.camera.position
    points = random_points(near_positions, 200, center, 20.0, frames, torch.Generator().manual_seed(0))
    seen = [project(frame.camera, points.positions) for frame in frames]
    assert not (seen[0][2] & seen[1][2]).any()
    for frame, (pixels, _, inside) in zip(frames, seen, strict=True):
        assert 50 < int(inside.sum()) < 150
        column, row = pixels[inside].long().unbind(1)
        assert torch.equal(points.colors[inside], frame.image[row, column] / 255)
    assert len(points) == 200


def test_views_of_nothing_give_up():
    behind = torch.tensor([-100.0, 0.0, 0.0])
    assert len(random_points(near_positions, 40, behind, 20.0, [frame_at(0)], torch.Generator().manual_seed(0))) == 0
