from dataclasses import replace

import pytest
import torch

from sparsestreet.geometry.cameras import ray_directions
from sparsestreet.ops import SplatSettings, over_sky
from sparsestreet.scene.effects import Sky, SkySettings, sky
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import StaticMask
from sparsestreet.scene.nodes import Rigid
from sparsestreet.scene.rendering import RenderOptions, SceneRendering, render
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.types import Frame, View
from tests.scene.street import background, camera_at, keyframes, pose, random_rows, rigid, static_mask, track, view_at
from tests.typed import as_a

MASK = static_mask(sparsity_weight=0.1)
CAMERA = camera_at(-6.0, width=17, height=11)


def scene_of(road_rows: int = 9, car_rows: int = 5, mask: StaticMask | None = MASK, dtype=torch.float32) -> SceneGraph:
    """A road about the origin, 6 m before the camera, a car that moves across, a sky of many colors."""
    instances = torch.zeros(car_rows, dtype=torch.int64)
    car = track("car", [0, 1], [pose(0.0, (0.0, -1.0, 1.0)), pose(0.4, (0.0, 1.0, 1.0))])
    rows = random_rows(car_rows, 1, instances=instances, mask=mask, dtype=dtype)
    cars = rigid(rows, keyframes([car], 2, dtype=dtype), mask=mask, max_gap=1.0)
    sky = Sky(SkySettings(resolution=4)).to(dtype)
    with torch.no_grad():
        sky.texels.uniform_(0, 1, generator=torch.Generator().manual_seed(2))
    road = background(random_rows(road_rows, 0, mask=mask, dtype=dtype), mask)
    return SceneGraph({"road": road, "cars": cars}, {"sky": sky})


def rendered(scene: SceneGraph, time: float = 0.5) -> SceneRendering:
    return render(scene, view_at(time, CAMERA), options=RenderOptions(backend="reference"))


def test_gradients_on_screen_are_kept_where_the_state_asks_for_them():
    options = RenderOptions(backend="reference")
    asked, plain = (
        render(scene_of(), view_at(0.5, CAMERA), SceneState(screen_gradients=wanted), options)
        for wanted in (True, False)
    )
    for result in (asked, plain):
        result.rgb.sum().backward()
    assert float(asked.splats.screen_gradients.abs().sum()) > 0
    with pytest.raises(ValueError, match="screen_gradients=True"):
        _ = plain.splats.screen_gradients


def test_a_novel_view_needs_no_frame_and_no_camera_of_the_log():
    scene, blank = scene_of(), torch.zeros(11, 17, 3, dtype=torch.uint8)
    novel = View(CAMERA, 0.5)
    assert novel.frame_index is None
    assert novel.camera_index is None
    expected = rendered(scene, 0.5)
    options = RenderOptions(backend="reference")
    for view in (novel, View(CAMERA, 0.5, frame_index=1), Frame(CAMERA, 0.5, 7, 3, image=blank)):
        assert torch.equal(render(scene, view, options=options).rgb, expected.rgb)
    assert not torch.equal(render(scene, View(CAMERA, 0.9), options=options).rgb, expected.rgb)


def test_a_finished_scene_shows_all_that_it_has():
    """State is what training adds to a view; without it a scene is finished."""
    assert SceneState() == FINISHED == SceneState(progress=1.0, sh_degree=3, training=False)
    scene, options = scene_of(), RenderOptions(backend="reference")
    finished = rendered(scene).rgb
    assert torch.equal(render(scene, view_at(0.5, CAMERA), FINISHED, options).rgb, finished)
    assert torch.equal(render(scene, view_at(0.5, CAMERA), SceneState(sh_degree=1), options).rgb, finished)
    young = render(scene, view_at(0.5, CAMERA), SceneState(sh_degree=0), options)
    assert not torch.equal(young.rgb, finished)
    for node in scene.nodes.values():
        with torch.no_grad():
            node.rows.sh_rest.zero_()
    assert torch.equal(rendered(scene).rgb, young.rgb)


def test_options_are_those_of_the_op():
    scene, view = scene_of(), view_at(0.5, CAMERA)
    default, usual = render(scene, view), SplatSettings(antialias=True)
    assert torch.equal(default.rgb, render(scene, view, options=RenderOptions(usual, "auto")).rgb)
    coarse = render(scene, view, options=RenderOptions(replace(usual, alpha_min=0.2)))
    assert coarse.alpha.sum() < default.alpha.sum()
    with pytest.raises(ValueError, match="no-such-backend"):
        render(scene, view, options=RenderOptions(backend="no-such-backend"))


def test_the_sky_ends_where_the_options_finish_a_pixel():
    options = RenderOptions(SplatSettings(transmittance_min=0.9), backend="reference")
    scene = scene_of()
    with_sky = render(scene, view_at(0.5, CAMERA), options=options)
    sky = as_a(Sky, scene.effects["sky"]).colors(ray_directions(CAMERA))
    light = 1 - with_sky.alpha
    assert ((light > 0.1) & (light < 0.9)).any()
    expected = with_sky.splats.rgb + torch.where(light > 0.9, light, 0.0)[..., None] * sky
    torch.testing.assert_close(with_sky.rgb, expected, atol=1e-6, rtol=0)  # one float32 rounding


@pytest.mark.parametrize(("backend", "taken"), [("reference", "torch"), ("cpu", "cpu"), ("auto", "auto")])
def test_the_sky_takes_the_backend_of_the_splats(monkeypatch, backend, taken):
    asked = []

    def recorded(*arguments, **options):
        asked.append(options["backend"])
        return over_sky(*arguments, **options)

    monkeypatch.setattr(sky, "over_sky", recorded)
    result = render(scene_of(), view_at(0.5, CAMERA), options=RenderOptions(backend=backend))
    assert asked == [taken]
    torch.testing.assert_close(result.rgb, rendered(scene_of()).rgb, atol=1e-5, rtol=0)  # the bar of the splats


def test_an_empty_scene_is_the_sky():
    scene = scene_of(0, 0)
    result = rendered(scene)
    assert torch.equal(result.rgb, as_a(Sky, scene.effects["sky"]).colors(ray_directions(CAMERA)))
    assert (result.alpha == 0).all()


def test_masked_rows_change_no_bit_of_the_image_when_they_go():
    scene = scene_of()
    with torch.no_grad():
        scene.nodes["road"].rows.mask_logits[::2] = -6.0
        scene.nodes["cars"].rows.mask_logits[1:3] = -6.0
    masked = rendered(scene)
    for node in scene.nodes.values():
        node.rows.resize(MASK.keep(node.rows).plan())
    removed = rendered(scene)
    assert scene.counts() == {"road": 4, "cars": 3}
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(getattr(masked, name), getattr(removed, name)), name


def test_absent_instances_change_no_bit_of_the_image():
    scene = scene_of()
    as_a(Rigid, scene.nodes["cars"]).spans.copy_(torch.tensor([[0.0, 0.2]]))
    absent = rendered(scene, 0.8)
    del scene.nodes["cars"]
    assert torch.equal(absent.rgb, rendered(scene, 0.8).rgb)


def test_the_image_moves_with_the_car():
    scene = scene_of(road_rows=0)
    middle = []
    for time in (0.0, 1.0):
        alpha = rendered(scene, time).alpha.detach().sum(0)
        middle.append(float((alpha * torch.arange(17.0)).sum() / alpha.sum()))
    assert middle[0] - middle[1] > 1  # y is to the left; 2 m at 6 m distance are 2.8 pixels


def test_the_last_frame_is_shown_at_its_own_time():
    scene = scene_of(road_rows=0)
    last = as_a(Rigid, scene.nodes["cars"]).keyframe_translations[0, -1]
    with torch.no_grad():
        scene.nodes["cars"].rows.means.zero_()
    placed = scene.gaussians_at(view_at(1.0, CAMERA)).gaussians
    assert torch.equal(placed.means, last.expand(5, 3))
    means = rendered(scene, 1.0).rgb
    as_a(Rigid, scene.nodes["cars"]).keyframe_translations[0, 0] = 50.0
    assert torch.equal(rendered(scene, 1.0).rgb, means)


def test_gradients_reach_every_parameter():
    """Finite differences in float64 of a random projection of the image, one random direction per parameter."""
    scene = scene_of(dtype=torch.float64, mask=None)
    generator = torch.Generator().manual_seed(4)
    cotangent = torch.randn(11, 17, 3, generator=generator, dtype=torch.float64)

    def loss() -> torch.Tensor:
        return (rendered(scene, 0.3).rgb * cotangent).sum()

    loss().backward()
    for name, parameter in scene.named_parameters():
        direction = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        step = 1e-7
        with torch.no_grad():
            parameter += step * direction
            above = loss()
            parameter -= 2 * step * direction
            below = loss()
            parameter += step * direction
        slope = (above - below) / (2 * step)
        analytic = (parameter.grad * direction).sum()
        assert analytic.abs() > 1e-6, name
        # Second order in the step, and rounding 1e-16 / 1e-7; cut-offs at alpha 1/255 may jump by little.
        torch.testing.assert_close(analytic, slope, rtol=1e-4, atol=1e-5, msg=lambda m, name=name: f"{name}: {m}")


def test_bfloat16_autocast_changes_nothing():
    scene = scene_of()
    expected = rendered(scene)
    with torch.autocast("cpu", torch.bfloat16):
        result = rendered(scene)
    assert torch.equal(result.rgb, expected.rgb)
    with torch.autocast("cpu", torch.bfloat16):
        assert MASK.scores(scene.nodes["road"].rows).dtype == torch.float32
