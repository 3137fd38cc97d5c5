"""Images that are gathered over an exposure, against the mean light of many images of their instants."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.cameras import inverse
from sparsestreet.scene.effects import MotionBlur, MotionBlurSettings, plan_effects
from sparsestreet.scene.effects.optics import moments_of, num_moments
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import GatheredSplats, light_of, render, stored_of
from sparsestreet.scene.state import RenderOptions, SceneState
from sparsestreet.types import Shutter, View
from tests.scene.street import (
    background,
    camera_at,
    keyframes,
    pose,
    random_rows,
    rigid,
    street_log,
    track,
    training_data,
)
from tests.typed import as_a, there

OPTIONS = RenderOptions(backend="reference")
CAMERA = replace(camera_at(-6.0, width=33, height=21), exposure=0.02)
MOTION = Shutter(torch.tensor([0.5, 0.0, 0.3]), torch.tensor([0.0, 0.03, 0.02]), seconds=0.02, span=0.2)
VIEW = View(CAMERA, 0.5, 2, 0)


def blur(moments: int = 3, motion: Shutter = MOTION) -> MotionBlur:
    return MotionBlur(MotionBlurSettings(when="auto"), {(2, 0): motion}, moments)


def street(**effects) -> SceneGraph:
    """A background, and a car that drives 2 m to the left over the log."""
    poses = [pose(0.0, (0.0, 1.0 - 0.5 * frame, 1.5)) for frame in range(5)]
    rows = random_rows(5, 1, instances=torch.zeros(5, dtype=torch.long))
    cars = rigid(rows, keyframes([track("car", list(range(5)), poses)], 5), max_gap=1.0)
    return SceneGraph({"road": background(random_rows(9, 0)), "cars": cars}, effects)


def at(share: float) -> View:
    """The view as it is at a share of its exposure, by the matrix exponential; cars follow its time."""
    turn = torch.linalg.matrix_exp(
        share * torch.tensor([[0.0, -0.02, 0.03], [0.02, 0.0, 0.0], [-0.03, 0.0, 0.0]], dtype=torch.float64)
    )
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, :3], moved[:3, 3] = turn, share * MOTION.translation.double()
    camera_from_world = (inverse(moved) @ CAMERA.camera_from_world.double()).float()
    return View(replace(CAMERA, camera_from_world=camera_from_world), 0.5 + share * MOTION.span)


def srgb_light(stored: torch.Tensor) -> np.ndarray:
    """IEC 61966-2-1 in NumPy."""
    values = stored.numpy().astype(np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0.05) + 0.055) / 1.055) ** 2.4)


@torch.no_grad()
def test_an_image_is_the_mean_light_of_its_exposure():
    scene, fast = street(), RenderOptions(backend="cpu")
    shares = (np.arange(30) + 0.5) / 30 - 0.5
    expected = np.mean([srgb_light(render(scene, at(share), options=fast).rgb) for share in shares], 0)
    sharp = srgb_light(render(scene, VIEW, options=fast).rgb)
    off = {
        count: np.abs(srgb_light(render(street(blur=blur(count)), VIEW, options=fast).rgb) - expected).max()
        for count in (2, 3, 5)
    }
    unblurred = np.abs(sharp - expected).max()
    assert unblurred > 0.05
    # Each moment takes two more orders of the motion: what is left falls fast, to what 30 moments resolve.
    assert off[2] < 0.25 * unblurred
    assert off[3] < 0.5 * off[2]
    assert off[5] < min(off[3], 0.01 * unblurred)


@torch.no_grad()
def test_what_a_moment_shows_is_what_the_view_of_then_shows():
    """One moment in the middle is the sharp image; cars are where their boxes are then."""
    scene = street()
    sharp = render(scene, VIEW, options=OPTIONS)
    middle = render(street(blur=blur(1)), VIEW, options=OPTIONS)
    # Float32, encoded and decoded.
    torch.testing.assert_close(middle.rgb, sharp.rgb, rtol=0, atol=1e-5)
    torch.testing.assert_close(middle.depth, sharp.depth, rtol=0, atol=1e-4)
    both = render(street(blur=blur(2)), VIEW, options=OPTIONS)
    ends = [render(scene, at(share), options=OPTIONS) for share, _ in moments_of(2)]
    torch.testing.assert_close(both.alpha, (ends[0].alpha + ends[1].alpha) / 2, rtol=0, atol=1e-5)
    assert torch.equal(both.splats.radii, torch.maximum(ends[0].splats.radii, ends[1].splats.radii))
    assert (ends[0].alpha - ends[1].alpha).abs().max() > 0.05


@torch.no_grad()
@pytest.mark.parametrize(
    "view",
    [
        replace(VIEW, frame_index=None),
        replace(VIEW, frame_index=1),
        replace(VIEW, camera_index=None),
        replace(VIEW, camera=replace(CAMERA, exposure=0.0)),
    ],
)
def test_a_view_that_nobody_recorded_is_sharp(view):
    assert torch.equal(
        render(street(blur=blur()), view, options=OPTIONS).rgb, render(street(), view, options=OPTIONS).rgb
    )


def test_gradients_of_all_moments_come_together():
    """Against central differences in float64, and the screen gradients of each moment alone."""
    scene = street(blur=blur(2)).double()
    means = scene.nodes["road"].rows.means
    weights = torch.rand(21, 33, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rendering = render(scene, VIEW, SceneState(training=True, screen_gradients=True), OPTIONS)
    (rendering.rgb * weights).sum().backward()
    direction = torch.randn(means.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    values = []
    with torch.no_grad():
        for step in (1e-5, -1e-5):
            means += step * direction
            values.append(float((render(scene, VIEW, options=OPTIONS).rgb * weights).sum()))
            means -= step * direction
    slope = (values[0] - values[1]) / 2e-5
    # Cameras and boxes are float32; the difference is good to 1e-6 of the slope.
    assert float((means.grad * direction).sum()) == pytest.approx(slope, rel=1e-4)
    splats = as_a(GatheredSplats, rendering.splats)
    gathered = splats.screen_gradients
    alone = [there(one.screen_offsets.grad) for one in splats.moments]
    assert torch.equal(gathered, alone[0] + alone[1])
    assert all(float(one.abs().max()) > 0 for one in alone)


def test_light_and_stored_values_undo_each_other():
    values = torch.linspace(-0.2, 1.5, 200, dtype=torch.float64)[:, None, None].expand(-1, 1, 3)
    torch.testing.assert_close(stored_of(light_of(values)), values)
    inside = values[values[:, 0, 0] > 0.05]
    np.testing.assert_allclose(light_of(inside).numpy(), srgb_light(inside), rtol=1e-12)
    edge = torch.tensor([[[0.0, -0.1, 0.04045]]], requires_grad=True)
    stored_of(light_of(edge)).sum().backward()
    torch.testing.assert_close(edge.grad, torch.ones(1, 1, 3), rtol=0.02, atol=0)  # the standard's kink is 1 % wide


def exposed_log(seconds: float) -> DrivingLog:
    """At 10 frames a second, 5 m/s forward."""
    log = street_log()
    frames = [
        replace(frame, camera=replace(frame.camera, exposure=seconds), seconds=0.1 * number)
        for number, frame in enumerate(log.frames)
    ]
    return replace(log, frames=as_frames(tuple(frames)))


def test_a_log_calls_for_it_from_the_threshold_on():
    """The blur grows in proportion to the exposure."""
    pixels = there(MotionBlurSettings(when="auto").detect(training_data(exposed_log(0.01))).value)
    settings = MotionBlurSettings(when="auto", min_blur=pixels)
    for times, on in ((0.5, False), (0.99, False), (1.01, True), (2.0, True)):
        (planned,) = plan_effects({"blur": settings}, training_data(exposed_log(times * 0.01))).effects
        assert planned.on == on
        assert planned.finding.value == pytest.approx(times * pixels, rel=0.01)  # the camera comes a little closer


@pytest.mark.parametrize(
    ("log", "lacks"),
    [
        (street_log(), "no camera of hand-made declares how long it is exposed"),
        (exposed_log(0.0), "no camera of hand-made declares"),
        (replace(exposed_log(0.01), frames=as_frames((exposed_log(0.01).frames[0],))), "no clock and no readout tell"),
    ],
    ids=["silent", "zero", "one frame"],
)
def test_what_is_not_declared_is_missing(log, lacks):
    data = training_data(log)
    assert not plan_effects({"blur": MotionBlurSettings(when="auto")}, data).effects[0].on
    with pytest.raises(ValueError, match=rf"effects.blur is on, but {lacks}.*reader that knows exposures"):
        plan_effects({"blur": MotionBlurSettings(when="on")}, data)


def test_held_out_images_are_blurred_too():
    """By their own poses, which are no pixels."""
    data = training_data(exposed_log(0.05), held_out=frozenset({2}))
    settings = MotionBlurSettings(when="on")
    made = settings.build(data, settings.detect(data), torch.Generator())
    assert set(made.motions) == {(frame, 0) for frame in range(5)}


def test_a_moment_more_is_a_frame_more():
    data = training_data(exposed_log(0.05))
    pixels = there(MotionBlurSettings(when="auto").detect(data).value)
    assert num_moments(pixels) == 2
    few = MotionBlurSettings(when="auto").cost(data)
    many = MotionBlurSettings(when="auto").cost(training_data(exposed_log(0.05 * 4 / pixels)))
    assert many.ns_per_row == 2 * few.ns_per_row > 0
