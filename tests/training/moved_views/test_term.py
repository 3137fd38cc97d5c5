"""The terms of a step, where its moved view stands, and what a run is told about its lidar before it trusts it."""

import logging
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.data.lidar import EdgeShift
from sparsestreet.scene.effects import LensSettings
from sparsestreet.scene.effects.exposure import Exposure, ExposureSettings
from sparsestreet.scene.effects.optics import Pinhole
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, SceneRendering, from_another_camera, render
from sparsestreet.scene.state import SceneState
from sparsestreet.training.moved_views import MovedViews, MovedViewTerm
from sparsestreet.training.moved_views import term as term_module
from sparsestreet.training.moved_views.returns import Colors, Returns, StreetReturns, target
from sparsestreet.training.moved_views.term import free_range, report_shift
from sparsestreet.types import Camera, Frame, Track, View
from tests.training.stubs import StubTrainer, background, frame_at, make_system, rigid

WIDTH, HEIGHT = 24, 16


def wall(depth: float) -> Returns:
    """A fine grid of returns on a plane before the camera, whose colors are its places; half of the weight."""
    x, y = torch.meshgrid(torch.linspace(-9, 9, 400), torch.linspace(-6, 6, 300), indexing="ij")
    points = torch.stack((x.flatten(), y.flatten(), torch.full((x.numel(),), depth)), 1)
    return Returns(points, whole((points / 20 + 0.5).clamp(0, 1)), torch.full((len(points),), 0.5))


def whole(colors: Tensor) -> Colors:
    """Of which none is cut off."""
    return Colors(colors, torch.zeros_like(colors, dtype=torch.bool))


def street(returns: Returns) -> StreetReturns:
    return StreetReturns(returns, (0,), (0, len(returns)), {}, ())


def seen(scene: SceneGraph, frame: Frame, step: int = 6) -> SceneRendering:
    return render(scene, frame, SceneState(0.5, 3, True, False, step), RenderOptions())


def scene() -> SceneGraph:
    return SceneGraph({"background": background(40, seed=3), "rigid": rigid(10)})


def test_the_same_gaussians_from_elsewhere_are_those_of_a_view_there():
    one, frame = scene(), frame_at(0, WIDTH, HEIGHT)
    pose = frame.camera.camera_from_world.clone()
    pose[0, 3] = -0.7
    there = View(replace(frame.camera, camera_from_world=pose), frame.time, frame.frame_index, frame.camera_index)
    rendering = seen(one, frame)
    again, anew = (
        from_another_camera(one, rendering, there, rendering.options),
        render(one, there, rendering.state, rendering.options),
    )
    assert torch.equal(again.rgb, anew.rgb)
    assert torch.equal(again.depth, anew.depth)
    assert not torch.equal(again.rgb, rendering.rgb)


def test_another_camera_is_seen_through_the_effects():
    """A lens that the scene leaves out is left out of both images."""
    plain, frame = scene(), frame_at(0, WIDTH, HEIGHT)
    without = SceneGraph(dict(plain.nodes.items()), {"lens": Pinhole(LensSettings(when="off"))})
    bent = View(replace(frame.camera, distortion=torch.tensor([-0.3, 0.05, 0.0, 0.0, 0.0])), frame.time)
    rendering = seen(plain, frame)
    with_lens, left_out = (from_another_camera(one, rendering, bent, rendering.options) for one in (plain, without))
    assert torch.equal(left_out.rgb, rendering.rgb)
    assert not torch.equal(with_lens.rgb, rendering.rgb)


@pytest.mark.parametrize("divisor", [1, 2])
def test_terms_by_hand(divisor):
    """Returns are compared pixel by pixel with what a camera at the drawn place renders, sampled at every second."""
    one, frame, depth = scene(), frame_at(0, WIDTH, HEIGHT), 4.0
    settings = MovedViews(divisor=divisor, depth_weight=3.0, color_weight=5.0, returns_per_view=1_000_000)
    term = MovedViewTerm(settings, street(wall(depth)), seed=7)
    rendering = seen(one, frame)
    terms = {name: value.item() for name, value in term(one, rendering, frame).items()}
    camera = place(term, frame)
    view = View(camera, frame.time, 0, 0)
    small = replace(RenderOptions().settings, eps2d=RenderOptions().settings.eps2d / divisor**2)
    with torch.no_grad():
        image = render(one, view, rendering.state, RenderOptions(settings=small))
    known = image.depth > 0.5
    inverse = torch.where(known, (1 / image.depth.clamp(min=0.5) - 1 / depth).abs(), 0.0)
    assert 0.2 < float(known.float().mean()) <= 1
    # The wall fills the image; half of the weight.
    assert terms["moved_depth"] == pytest.approx(3.0 * 0.5 * float(inverse.mean()), rel=1e-4)
    x = (torch.arange(camera.width) + 0.5 - camera.intrinsics[0, 2]) / camera.intrinsics[0, 0] * depth
    y = (torch.arange(camera.height) + 0.5 - camera.intrinsics[1, 2]) / camera.intrinsics[1, 1] * depth
    x = x - camera.camera_from_world[0, 3]
    places = torch.stack((x.expand(camera.height, -1), y[:, None].expand(-1, camera.width)), -1) / 20 + 0.5
    error = (image.rgb[..., :2] - places).abs().sum(-1) + (image.rgb[..., 2] - (depth / 20 + 0.5)).abs()
    expected = 5.0 * 0.5 * float(torch.where(known, error / 3, 0.0).mean())
    # A return lies up to half a sampled pixel from its center: 4 m x 0.5 / 12 px / 20 = 0.8 % of a color at most.
    assert terms["moved_color"] == pytest.approx(expected, abs=5.0 * 0.5 * 0.01)


def place(term: MovedViewTerm, frame: Frame) -> Camera:
    """Where the view of step 6 stands: the first draw of its stream."""
    distance = -4.0 + 8.0 * float(torch.rand((), generator=named_generator(7, "moved view 6")))
    pose = frame.camera.camera_from_world.clone()
    pose[0, 3] = -distance
    divisor = term.settings.divisor
    intrinsics = frame.camera.intrinsics.clone()
    intrinsics[:2] /= divisor
    return Camera(pose, intrinsics, WIDTH // divisor, HEIGHT // divisor)


def test_gradients_reach_the_nodes_and_draws_depend_on_the_step_alone():
    one, frame = scene(), frame_at(0, WIDTH, HEIGHT)
    values = {}
    for step in (3, 6, 3):
        term = MovedViewTerm(MovedViews(), street(wall(4.0)), seed=7)
        terms = term(one, seen(one, frame, step), frame)
        values.setdefault(step, []).append(sum(value.item() for value in terms.values()))
    assert values[3][0] == values[3][1] != values[6][0]
    torch.stack(tuple(term(one, seen(one, frame), frame).values())).sum().backward()
    for node in one.nodes.values():
        assert node.rows.means.grad is not None
        assert node.rows.means.grad.abs().max() > 0


def test_what_a_view_is_compared_with(monkeypatch):
    """Returns of the sweeps around its frame, near its field of view; objects and boxes of its own instant."""
    behind, ahead, right = [0.0, 0.0, -9.0], [0.0, 0.0, 9.0], [9.5, 0.0, 6.0]  # the last 2.5 m outside the image
    points = torch.tensor([ahead, behind, ahead, right, ahead])
    both = Returns(points, whole(torch.zeros(5, 3)), torch.arange(5.0) / 5)
    car = Returns(torch.ones(1, 3), whole(torch.ones(1, 3)), torch.ones(1))
    poses = torch.eye(4, dtype=torch.float64)[None].repeat(2, 1, 1)
    poses[1, 0, 3] = 2.0
    times = torch.tensor([0.3, 0.7], dtype=torch.float64)
    track = Track("car", "car", torch.tensor([2, 3]), poses, torch.ones(3), times=times)
    returns = StreetReturns(both, (0, 2, 9), (0, 1, 4, 5), {2: car}, (track,))
    asked, drawn = [], []
    monkeypatch.setattr(term_module, "target", lambda *given: asked.append(given) or target(*given))
    again = term_module.from_another_camera
    monkeypatch.setattr(term_module, "from_another_camera", lambda *given: drawn.append(given[2]) or again(*given))
    one, frame = scene(), replace(frame_at(2, WIDTH, HEIGHT), time=0.5, seconds=3.5, stamp=7)
    for most in (9, 1):
        term = MovedViewTerm(MovedViews(sweeps=1, returns_per_view=most, divisor=2), returns, seed=0)
        term(one, seen(one, frame), frame)
    street, objects, boxes, reach = asked[0][1:]
    assert (street.weights * 5).round().tolist() == [2.0, 3.0]
    assert objects is car
    assert len(boxes) == 1
    torch.testing.assert_close(boxes[0][0], poses.mean(0))  # its image is taken between the two boxes
    assert reach == 0.25
    assert len(asked[1][1]) == 1
    view = drawn[0]
    assert (view.time, view.indices, view.seconds, view.stamp) == (frame.time, frame.indices, 3.5, 7)


def test_cameras_of_a_frame_see_their_own_returns(monkeypatch):
    """The second camera of a frame looks backwards: what is near it is not what is near the first."""
    points = torch.tensor([[0.0, 0.0, 9.0], [0.0, 0.0, -9.0], [0.5, 0.0, -8.0]])
    returns = StreetReturns(Returns(points, whole(torch.zeros(3, 3)), torch.ones(3)), (0,), (0, 3), {}, ())
    asked = []
    monkeypatch.setattr(term_module, "target", lambda *given: asked.append(given[1]) or target(*given))
    one, front = scene(), frame_at(0, WIDTH, HEIGHT)
    backwards = front.camera.camera_from_world @ torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    rear = replace(front, camera=replace(front.camera, camera_from_world=backwards), camera_index=1)
    term = MovedViewTerm(MovedViews(), returns, seed=7)
    for frame in (front, rear, front):
        term(one, seen(one, frame), frame)
    assert [each.points[:, 2].tolist() for each in asked] == [[9.0], [-9.0, -8.0], [9.0]]


def test_floaters_before_the_camera_are_left_to_the_recorded_views():
    """Rendered depths up to 0.5 m count nothing: the inverse would know nothing else."""
    one, frame = scene(), frame_at(0, WIDTH, HEIGHT)
    rendering = seen(one, frame)
    term = MovedViewTerm(MovedViews(divisor=1), street(wall(4.0)), seed=7)
    usual = term(one, rendering, frame)["moved_depth"].item()
    means = rendering.gaussians.means.detach().clone()
    means[:, 2] = 0.35
    floaters = replace(rendering.gaussians, means=means)
    blocked = term(one, replace(rendering, gaussians=floaters), frame)["moved_depth"].item()
    assert usual > 0
    assert blocked < usual / 10


def test_gains_of_images_are_no_matter_of_moved_views():
    """Returns have lost them: a brighter image is compared with the same colors, and gains learn nothing there."""
    plain, frame = scene(), frame_at(0, WIDTH, HEIGHT)
    exposure = Exposure(ExposureSettings(), {0: [0.0, 1.0]})
    exposure.start_from([frame], torch.tensor([[0.4, -0.1, 0.2]]))
    bright = SceneGraph(dict(plain.nodes.items()), {"exposure": exposure})
    term = MovedViewTerm(MovedViews(), street(wall(4.0)), seed=7)
    colors = [term(one, seen(one, frame), frame)["moved_color"] for one in (plain, bright)]
    assert not torch.equal(seen(plain, frame).rgb, seen(bright, frame).rgb)
    torch.testing.assert_close(colors[1], colors[0], rtol=1e-6, atol=0.0)  # of one rounding more
    (gradient,) = torch.autograd.grad(colors[1], [exposure.log_gains])
    assert gradient.abs().max() < 1e-7 * colors[1]  # two terms that cancel to rounding


def test_which_steps_have_a_moved_view():
    term = MovedViewTerm(MovedViews(every=3, start=0.1, stop=0.9), street(wall(4.0)), seed=0)
    assert [term.applies(step, 0.5) for step in (0, 1, 2, 3)] == [True, False, False, True]
    assert [term.applies(3, progress) for progress in (0.09, 0.1, 0.89, 0.9)] == [False, True, True, False]
    nothing = MovedViewTerm(MovedViews(), street(Returns.concatenate([])), seed=0)
    assert not nothing.applies(3, 0.5)


def test_a_camera_keeps_off_walls():
    frame = frame_at(0, WIDTH, HEIGHT)
    points = torch.tensor([[2.0, 0.1, 0.3], [-1.2, 0.4, 0.0], [0.7, 0.6, 0.0], [0.9, 0.0, 4.0], [-0.3, 0.0, 0.6]])
    assert free_range(frame.camera, points, 4.0) == (pytest.approx(-0.7), pytest.approx(1.5))
    assert free_range(frame.camera, torch.tensor([[0.2, 0.0, 0.0]]), 4.0) == (-4.0, 0.0)
    assert free_range(frame.camera, torch.zeros(0, 3), 4.0) == (-4.0, 4.0)


def test_a_step_adds_the_terms_and_one_without_them_is_as_before():
    def step(every: int | None) -> tuple[float, bool]:
        term = None if every is None else MovedViewTerm(MovedViews(every=every), street(wall(4.0)), seed=7)
        trainer = StubTrainer(make_system({"background": background(40, seed=3)}, moved_views=term), max_steps=12)
        trainer.global_step = 6
        value = trainer.system.training_step(frame_at(0, WIDTH, HEIGHT), 0).item()
        return value, {"train/moved_depth", "train/moved_color"} <= trainer.system.said.newest.keys()

    (plain, _), (with_terms, said) = step(None), step(3)
    assert with_terms > plain
    assert said
    assert step(5) == (plain, False)


@pytest.mark.parametrize(
    ("shift", "level", "said"),
    [
        (EdgeShift(0.9, -1.9, 900), logging.INFO, "0.9 pixels to the right of those of the lidar and -1.9 below"),
        (EdgeShift(-0.1, -2.1, 900), logging.WARNING, "-2.1 below: check calibration, poses and stamps"),
        (EdgeShift(-1.1, 0.0, 900), logging.WARNING, "-1.1 pixels to the right"),
        (None, logging.INFO, "too few edges are seen by lidar and cameras"),
    ],
)
def test_a_lidar_beside_the_images_is_warned_of(
    shift: EdgeShift | None, level: int, said: str, caplog: pytest.LogCaptureFixture
):
    with caplog.at_level(logging.INFO):
        report_shift(shift)
    assert [record.levelno for record in caplog.records] == [level]
    assert said in caplog.text
