"""Intensities that Gaussians learn of returns: by hand, where only one Gaussian can be met."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sparsestreet.scene.edits import Added, Change, Edits, Moved, edited
from sparsestreet.scene.gaussians import INTENSITIES, RowPlan, Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.intensities import intensities_of, learn_intensities
from sparsestreet.scene.lidar import rays_to
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene, load_scene, save_scene
from sparsestreet.scene.street_file import save_street
from sparsestreet.scene.sweeps import render_sweep
from sparsestreet.types import Sweep
from tests.scene.street import keyframes, pose, rigid, track
from tests.scene.test_lidar import OPTIONS, crooked_pose, in_world, rows_at, scene_of, unit
from tests.scene.test_sweeps import model_of

STEP = 0.51 / 255
"""Half of a step, and what float32 adds."""
AZIMUTHS = torch.tensor([10.0, 75.0, 130.0, 200.0, 290.0])
BALLS = 12 * unit(AZIMUTHS, torch.tensor([5.0, -8.0, 0.0, 20.0, -3.0]))
"""Around the lidar, none before another."""


def street() -> SceneGraph:
    return scene_of(rows_at(in_world(BALLS, crooked_pose())))


def sweep(points: Tensor, origin: Tensor | None = None, time: float = 0.5) -> Sweep:
    origin = crooked_pose()[:3, 3] if origin is None else origin
    return Sweep(0, time, points.float(), torch.zeros(len(points), 3), torch.ones(len(points)).bool(), origin=origin)


def at_balls(shares: list[float], balls: list[int]) -> Tensor:
    """Points along the rays to balls, at so much of their distance, in the world."""
    return in_world(torch.tensor(shares, dtype=torch.float64)[:, None] * BALLS[balls], crooked_pose())


def test_each_row_has_the_mean_of_its_returns_and_others_that_of_the_nearest():
    """Three returns of ball 0 in two sweeps, one of ball 3, one of the recording car; what ends elsewhere on a ray is
    of something else."""
    scene = street()
    first = sweep(at_balls([0.03, 1.0, 1.01, 1.0, 0.8], [2, 0, 0, 3, 3])), torch.tensor([0.9, 0.2, 0.6, 1.0, 0.0])
    second = sweep(at_balls([0.99, 1.2], [0, 1])), torch.tensor([0.7, 0.9])
    assert learn_intensities(scene, [first, second], OPTIONS) == 2
    # Of balls 1 and 4 ball 0 is the nearest, of ball 2 ball 3.
    assert intensities_of(scene).tolist() == pytest.approx([0.5, 0.5, 1.0, 1.0, 0.5], abs=STEP)


def test_returns_of_the_recording_car_say_nothing():
    points = torch.cat((at_balls([0.03, 1.0], [0, 0]), at_balls([1.0], [1])))
    places, ranges, rays = rays_to(sweep(points))
    assert places.tolist() == [1, 2]
    torch.testing.assert_close(ranges, torch.tensor([12.0, 12.0]).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(rays.directions, in_world(BALLS[:2], turned()).float() / 12, atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match="nobody knows where the lidar of sweep 0 stood"):
        rays_to(replace(sweep(points), origin=None))


def turned() -> Tensor:
    matrix = crooked_pose()
    matrix[:3, 3] = 0
    return matrix


def two_cars() -> SceneGraph:
    """A wall of one ball, and two cars of the same node, 10 m ahead and to the left; each has a ball at its middle and
    one above, in its own frame."""
    tracks = [track(name, [0, 1], [pose(0.3, place)] * 2) for name, place in (("a", (10, 0, 0)), ("b", (0, 10, 0)))]
    middles = torch.tensor([[0.0, 0, 0], [0, 0, 0.7], [0, 0, 0.05], [0, 0, 0.7]])
    rows = rows_at(middles, instances=torch.tensor([0, 0, 1, 1]))
    cars = rigid(rows, keyframes(tracks, 2), names=["a", "b"], max_gap=2.0)
    wall = scene_of(rows_at(torch.tensor([[-10.0, 0, 0]]))).nodes["road"]
    return SceneGraph({"cars": cars, "road": wall})


def learned_cars() -> SceneGraph:
    """Returns of the middles of both cars: dark and bright."""
    scene = two_cars()
    points = torch.tensor([[10.0, 0, 0], [0, 10, 0.05]])
    learn_intensities(scene, [(sweep(points, torch.zeros(3).double()), torch.tensor([0.2, 0.8]))], OPTIONS)
    return scene


def test_an_object_takes_nothing_of_another_and_a_node_without_returns_has_none():
    """The upper ball of each car is nearer to the other's in the frames of the boxes."""
    scene = learned_cars()
    assert INTENSITIES not in scene.nodes["road"].rows.columns()
    assert intensities_of(scene).tolist() == pytest.approx([0.2, 0.2, 0.8, 0.8, 0.0], abs=STEP)
    assert intensities_of(two_cars()) is None


def test_sweeps_have_them_also_of_what_edits_moved_and_copied():
    """The dark car 2 m ahead of its place, the bright one and its copy 6 m to the left of it, and the wall."""
    moved = {"a": Change(Moved(forward=2.0))}
    scene = edited(learned_cars(), Edits(moved, {"again": Added("b", Change(Moved(right=-6.0)))}))
    forward, left = torch.tensor([math.cos(0.3), math.sin(0.3), 0]), torch.tensor([-math.sin(0.3), math.cos(0.3), 0])
    bright = torch.tensor([0, 10.0, 0.05])
    places = torch.stack(
        (torch.tensor([10.0, 0, 0]) + 2 * forward, bright, bright + 6 * left, torch.tensor([-10.0, 0, 0]))
    )
    azimuths = torch.atan2(places[:, 1], places[:, 0]).rad2deg().tolist()

    def still(_: float) -> Tensor:
        return torch.eye(4, dtype=torch.float64)

    found = render_sweep(scene, model_of([0.0], azimuths), still, 0.0, OPTIONS, duration=2.0)
    torch.testing.assert_close(found.points.float(), places * torch.tensor([1, 1, 0]), atol=0.01, rtol=0)
    assert found.intensities.tolist() == pytest.approx([0.2, 0.8, 0.8, 0.0], abs=STEP)


@pytest.mark.parametrize("write", [save_scene, save_street])
def test_files_keep_them(tmp_path: Path, write):
    scene = learned_cars()
    path = tmp_path / ("a.street" if write is save_street else "scene.safetensors")
    write(path, StoredScene(scene, RenderOptions(), "x", 2))
    found = load_scene(path).scene
    order = torch.tensor(found.nodes["cars"].rows.means[:, 2].tolist()).argsort()  # a .street has rows in its own order
    levels = found.nodes["cars"].rows.intensities[order]
    assert sorted(levels.tolist()) == [51, 51, 204, 204]
    assert levels[:2].tolist() == [51, 204]  # of the middles, at 0 and 0.05 m
    assert found.nodes["cars"].rows.columns()[INTENSITIES].dtype == torch.uint8


def test_rows_take_them_along_and_a_checkpoint_brings_them():
    scene = learned_cars()
    rows = scene.nodes["cars"].rows
    bytes_before = two_cars().nodes["cars"].row_bytes()
    assert scene.nodes["cars"].row_bytes() == bytes_before  # no image needs them
    fresh = two_cars()
    fresh.load_state_dict(scene.state_dict())
    assert torch.equal(fresh.nodes["cars"].rows.intensities, rows.intensities)
    rows.resize(RowPlan(4, torch.tensor([3, 0, 3]), torch.tensor([False, False, True])))
    assert (rows.intensities.double() / 255).tolist() == pytest.approx([0.8, 0.2, 0.8], abs=STEP)
    assert len(Rows.of({name: column.detach() for name, column in rows.columns().items()})) == 3
