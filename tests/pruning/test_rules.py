"""The leave-one-out rule on a scene whose answer is known, and both rules' errors."""

import copy
import math
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import pytest
import torch

from sparsestreet.pruning import Floors, ImportanceRule, LeaveOneOutRule, PruningRule, RenderContext
from sparsestreet.scene.effects import Effect, Sky, SkySettings
from sparsestreet.scene.gaussians import Rows, Selection
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.types import Camera, Frame, Rendering, View
from tests.cli.toy.gain import Gain, GainSettings
from tests.scene.street import background

OPTIONS = RenderOptions(backend="reference")
CONTEXT = RenderContext(options=OPTIONS)


def scene_of(
    opacities: list[float], depths: list[float], *, min_gaussians: int = 0, effects: Mapping[str, Effect] | None = None
) -> SceneGraph:
    """Large white discs across the view, one behind the other."""
    n = len(opacities)
    rows = Rows(
        {
            "means": torch.tensor([[0.0, 0.0, z] for z in depths]),
            "log_scales": torch.full((n, 3), 3.0),
            "quaternions": torch.tensor([[1.0, 0, 0, 0]] * n),
            "opacity_logits": torch.tensor(opacities).logit(),
            "sh_dc": torch.full((n, 1, 3), 1.7),
            "sh_rest": torch.zeros(n, 0, 3),
        }
    )
    return SceneGraph({"background": background(rows, min_gaussians=min_gaussians)}, effects)


def frame_of(scene: SceneGraph, offset: int) -> Frame:
    """What the scene shows, off by ``offset`` 8-bit steps in every channel: so much is the present error."""
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 4.5], [0, 40.0, 3.5], [0, 0, 1]]), 9, 7)
    blank = Frame(camera, 0.0, 0, 0, image=torch.zeros(7, 9, 3, dtype=torch.uint8))
    with torch.no_grad():
        rgb = render(scene, blank, options=OPTIONS).rgb.clamp(0, 1)
    return replace(blank, image=((rgb * 255).round() - offset).clamp(0, 255).to(torch.uint8))


def test_a_budget_buys_the_cheapest_rows_and_no_more():
    # Front to back; white discs over black: removing row k changes a pixel by alpha_k times the light that gets
    # past all others, T_all / (1 - alpha_k) * alpha_k.
    opacities = [0.05, 0.3, 0.1]
    scene = scene_of(opacities, [2.0, 3.0, 4.0])
    frame = frame_of(scene, offset=20)
    through = 0.95 * 0.7 * 0.9
    value = 0.5 + 1.7 * 0.28209479177387814
    costs = [3 * 63 * (value * through * o / (1 - o)) ** 2 for o in opacities]
    with torch.no_grad():
        image = render(scene, frame, options=OPTIONS).rgb
    error = float((image.clamp(0, 1) - frame.image / 255).square().sum())
    for allowed, kept in (
        (0.9 * costs[0], [True, True, True]),
        (1.1 * costs[0], [False, True, True]),
        (1.02 * (costs[0] + costs[2]), [False, True, False]),
        (0.98 * (costs[0] + costs[2]), [False, True, True]),
    ):
        allowed_db = float(10 * torch.log10(torch.tensor(1 + allowed / error)))
        rule = LeaveOneOutRule(allowed_db, noticeable=0.0)
        assert rule.select(scene, [frame], CONTEXT)["background"].keep.tolist() == kept


def test_without_a_budget_only_what_nobody_sees_goes():
    # Two discs behind an opaque one: 0.01 of the light gets through, and of that 0.3 and 0.7 * 0.5: 0.9 steps of 255.
    scene = scene_of([0.99, 0.3, 0.5], [2.0, 3.0, 4.0])
    selection = LeaveOneOutRule(0.0).select(scene, [frame_of(scene, 5)], CONTEXT)["background"]
    assert selection.keep.tolist() == [True, False, False]
    strict = LeaveOneOutRule(0.0, noticeable=0.0)
    assert strict.select(scene, [frame_of(scene, 5)], CONTEXT)["background"].removed == 0


def test_a_row_seen_in_one_view_of_two_stays():
    scene = scene_of([0.99, 0.3], [2.0, 3.0])
    front = frame_of(scene, 5)
    # From behind the first disc the second is seen.
    pose = torch.eye(4)
    pose[2, 3] = -2.5
    behind = replace(front, camera=replace(front.camera, camera_from_world=pose))
    rule = LeaveOneOutRule(0.0)
    assert rule.select(scene, [front], CONTEXT)["background"].keep.tolist() == [True, False]
    assert rule.select(scene, [front, behind], CONTEXT)["background"].removed == 0


def test_a_row_that_only_a_view_beside_the_path_sees_stays_if_asked():
    # Beside the image, 45 degrees to the right at 2 m; from 2 m further right it stands in the middle.
    scene = scene_of([0.5, 0.5, 0.5], [3.0, 2.0, 2.0])
    with torch.no_grad():
        scene.nodes["background"].rows.means.copy_(torch.tensor([[0.0, 0.0, 2.0], [2.0, 0.0, 2.0], [-2.0, 0.0, 2.0]]))
        scene.nodes["background"].rows.log_scales.fill_(-4.0)
    frame = frame_of(scene, 5)
    right, left = replace(frame, frame_index=1), frame

    def kept(rule: LeaveOneOutRule, *frames: Frame) -> list[bool]:
        return rule.select(scene, frames, CONTEXT)["background"].keep.tolist()

    beside = LeaveOneOutRule(0.0, beside=2.0)
    assert kept(LeaveOneOutRule(0.0), right, left) == [True, False, False]
    assert kept(beside, right) == [True, True, False]
    assert kept(beside, left) == [True, False, True]
    assert kept(beside, right, left) == [True, True, True]


def test_a_change_beside_the_path_costs_what_it_costs_in_the_whole_image():
    scene = scene_of([0.5], [2.0])
    people = torch.zeros(7, 9, dtype=torch.bool)
    people[:3] = True
    frame = replace(frame_of(scene, 20), human=people)
    costs = LeaveOneOutRule(0.0, noticeable=0.0).costs(scene, [frame], CONTEXT)["background"]
    # 0.001 m beside the disc looks the same. Recorded, it counts twice: as image and as people.
    both = LeaveOneOutRule(0.0, noticeable=0.0, beside=0.001).costs(scene, [frame], CONTEXT)["background"]
    torch.testing.assert_close(both, 1.5 * costs, rtol=1e-3, atol=0.0)


def test_what_the_recording_car_hides_costs_nothing():
    scene = scene_of([0.5], [2.0])
    hood = torch.ones(7, 9, dtype=torch.bool)
    shown, hidden = frame_of(scene, 20), replace(frame_of(scene, 200), ego=hood)
    rule = LeaveOneOutRule(0.0, noticeable=0.0)
    (alone,), (both,) = (rule.costs(scene, frames, CONTEXT)["background"] for frames in ([shown], [shown, hidden]))
    # Neither the error on the hood, which is large, nor a change there counts.
    assert both == alone > 0


def test_a_vehicle_on_the_recording_car_costs_what_it_does_without_one():
    """A vehicle mirrored on the hood: the vehicle region is what is marked outside of the recording car."""
    scene = scene_of([0.5], [2.0])
    hood, vehicle = torch.zeros(7, 9, dtype=torch.bool), torch.zeros(7, 9, dtype=torch.bool)
    hood[5:], vehicle[2:] = True, True
    frame = frame_of(scene, 20)
    rule = LeaveOneOutRule(0.0, noticeable=0.0)
    over, beside = (
        rule.costs(scene, [replace(frame, ego=hood, vehicle=mask)], CONTEXT)["background"]
        for mask in (vehicle, vehicle & ~hood)
    )
    assert torch.equal(over, beside)


def _selection(scene: SceneGraph, frame: Frame, rule: PruningRule) -> Selection:
    return rule.select(scene, [frame], CONTEXT)["background"]


@pytest.mark.lengthy
@pytest.mark.parametrize("region", ["vehicle", "human"])
def test_what_shows_a_vehicle_or_a_person_costs_more(region: str):
    # Equal discs side by side, each in its own half of the image; one half is marked.
    scene = scene_of([0.5, 0.5], [2.0, 2.0])
    with torch.no_grad():
        scene.nodes["background"].rows.means.copy_(torch.tensor([[-0.12, 0.0, 2.0], [0.12, 0.0, 2.0]]))
        scene.nodes["background"].rows.log_scales.fill_(-4.5)
    frame = frame_of(scene, 20)
    halves = torch.zeros(7, 9, dtype=torch.bool)
    halves[:, 5:] = True
    for mask, kept in ((halves, [False, True]), (halves.flip(1), [True, False])):
        marked = replace(frame, **{region: mask})
        budgets = [LeaveOneOutRule(db, noticeable=0.0) for db in torch.linspace(0.1, 25, 250).tolist()]
        selection = partial(_selection, scene, marked)
        least = bisect_left(budgets, 1, key=lambda rule: selection(rule).removed)
        assert selection(budgets[least]).keep.tolist() == kept


def test_a_change_is_measured_over_the_sky():
    """A disc of the sky's color is not missed, a black one before the same sky is."""
    white = {"sky": Sky(SkySettings(resolution=2, initial_color=1.0))}
    color = (1.0 - 0.5) / 0.28209479177387814
    for sh_dc, effects, removed in ((color, white, 1), (-9.0, white, 0), (color, {}, 0), (-9.0, {}, 1)):
        scene = scene_of([0.3], [2.0], effects=effects)
        with torch.no_grad():
            scene.nodes["background"].rows.sh_dc.fill_(sh_dc)
        selection = LeaveOneOutRule(0.0).select(scene, [frame_of(scene, 5)], CONTEXT)["background"]
        assert selection.removed == removed


def without_row(scene: SceneGraph, row: int) -> SceneGraph:
    """The scene with a row of its background made invisible."""
    scene = copy.deepcopy(scene)
    with torch.no_grad():
        scene.nodes["background"].rows.opacity_logits[row] = -40.0
    return scene


class Vignette(Effect):
    """Brighter to the right, so that no two columns have one slope."""

    def slope(self, view: View) -> torch.Tensor:
        return torch.linspace(0.5, 1.5, view.camera.width).expand(view.camera.height, -1)

    def image(self, rgb: torch.Tensor, splats: Rendering, view: View, options: RenderOptions) -> torch.Tensor:
        return self.slope(view)[..., None] * rgb


@pytest.mark.parametrize("order", [["sky", "gain"], ["sky", "gain", "vignette"], ["gain", "sky"], ["gain"], ["sky"]])
def test_costs_are_those_of_images_behind_the_effects(order: list[str]):
    """Against rendering without each row in turn: a gain of 1.3 makes every change 1.3 times as large."""
    gain = Gain(GainSettings(evenness=0.0), 1)
    with torch.no_grad():
        gain.log_gains.fill_(math.log(1.3))
    effects = {
        "sky": Sky(SkySettings(resolution=2, initial_color=0.4)),
        "gain": gain,
        "vignette": Vignette(GainSettings(evenness=0.0)),
    }
    scene = scene_of([0.3, 0.2, 0.4], [2.0, 3.0, 4.0], effects={name: effects[name] for name in order})
    with torch.no_grad():
        scene.nodes["background"].rows.sh_dc.copy_(torch.tensor([0.5, -0.5, -1.0]).reshape(3, 1, 1))
    frame = frame_of(scene, 20)

    def image(seen: SceneGraph) -> torch.Tensor:
        with torch.no_grad():
            return render(seen, frame, options=OPTIONS).rgb.double()

    error = (image(scene).clamp(0, 1) - frame.image / 255).square().sum()
    expected = torch.stack([(image(without_row(scene, row)) - image(scene)).square().sum() for row in range(3)]) / error
    costs = LeaveOneOutRule(0.1, noticeable=0.0).costs(scene, [frame], CONTEXT)["background"]
    torch.testing.assert_close(costs, expected, rtol=1e-4, atol=0)  # images are float32, changes of 0.02 and more


def test_what_a_gain_makes_noticeable_is_not_free():
    """The last row moves a pixel by 0.87 steps of 255, and behind a gain of 1.3 by 1.14, or of 1.5 at one side."""
    gain, vignette = Gain(GainSettings(evenness=0.0), 1), Vignette(GainSettings(evenness=0.0))
    with torch.no_grad():
        gain.log_gains.fill_(math.log(1.3))
    for effects, last in (({}, False), ({"gain": gain}, True), ({"vignette": vignette}, True)):
        scene = scene_of([0.99, 0.3, 0.5], [2.0, 3.0, 4.0], effects=effects)
        costs = LeaveOneOutRule(0.0).costs(scene, [frame_of(scene, 5)], CONTEXT)["background"]
        assert (costs > 0).tolist() == [True, False, last]


def test_only_prunable_nodes_are_asked_each_with_its_own_floor():
    """A node that must not be pruned still stands in the way of what it hides."""
    rows = [scene_of([opacity], [depth]).nodes["background"].rows for opacity, depth in ((0.99, 2.0), (0.3, 3.0))]
    wall, hidden = background(rows[0], prunable=False), background(rows[1])
    scene = SceneGraph({"wall": wall, "hidden": hidden, "kept": background(rows[1], min_gaussians=1)})
    assert ImportanceRule().floors(scene, [], CONTEXT) == {"hidden": Floors(0), "kept": Floors(1)}
    for rule in (LeaveOneOutRule(0.0), ImportanceRule()):
        selections = rule.select(scene, [frame_of(scene, 5)], CONTEXT)
        assert {name: each.removed for name, each in selections.items()} == {"hidden": 1, "kept": 0}
        assert [each.floor_hit for each in selections.values()] == [False, True]


def test_a_scene_in_which_nothing_may_be_pruned():
    scene = SceneGraph({"wall": background(scene_of([0.99], [2.0]).nodes["background"].rows, prunable=False)})
    for rule in (LeaveOneOutRule(1.0), ImportanceRule()):
        assert rule.select(scene, [frame_of(scene, 5)], CONTEXT) == {}


def test_a_scene_without_error_loses_nothing_that_is_seen():
    """A budget relative to no error is no budget: an overexposed disc before a white truth stays."""
    scene = scene_of([0.99], [2.0])
    with torch.no_grad():
        scene.nodes["background"].rows.sh_dc.fill_(9.0)
    frame = frame_of(scene, 0)
    assert (frame.image == 255).all()
    assert LeaveOneOutRule(0.1).select(scene, [frame], CONTEXT)["background"].removed == 0


def test_the_floor_holds():
    scene = scene_of([0.99, 0.3, 0.9], [2.0, 3.0, 4.0], min_gaussians=2)
    for rule in (LeaveOneOutRule(50.0), ImportanceRule()):
        selection = rule.select(scene, [frame_of(scene, 5)], CONTEXT)["background"]
        assert int(selection.keep.sum()) == 2
        assert selection.floor_hit
        assert isinstance(rule, PruningRule)


@pytest.mark.parametrize("remove", [0.5, 2])
def test_a_number_of_the_whole_scene_goes_whatever_nodes_it_may_take_from(remove):
    """Mean blend weights, front to back: 0.5, 0.5 x 0.5, 0.25 x 0.1, 0.225 x 0.3."""
    mine, theirs = (
        background(scene_of(opacities, depths).nodes["background"].rows)
        for opacities, depths in (([0.5, 0.3], [2.0, 5.0]), ([0.5, 0.1], [3.0, 4.0]))
    )
    scene = SceneGraph({"mine": mine, "theirs": theirs})
    frames = [frame_of(scene, 5)]

    def kept(nodes: list[str] | None) -> dict[str, list[bool]]:
        chosen = ImportanceRule(gate=False, remove=remove, nodes=nodes).select(scene, frames, CONTEXT)
        return {name: each.keep.tolist() for name, each in chosen.items()}

    assert kept(None) == {"mine": [True, False], "theirs": [True, False]}
    assert kept(["mine"]) == {"mine": [False, False]}
    with pytest.raises(ValueError, match="have 2"):
        ImportanceRule(remove=3, nodes=["mine"]).select(scene, frames, CONTEXT)
    with pytest.raises(ValueError, match="remove must be"):
        ImportanceRule(remove=-0.5)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ((-0.1,), ">= 0 dB"),
        ((float("nan"),), ">= 0 dB"),
        ((0.1, -1.0), "must be >= 0"),
        ((0.1, 0.0, None, 0.0), "0 m"),
        ((0.1, 0.0, None, None, -1.0), "depth is a weight >= 0"),
    ],
)
def test_bad_settings_are_refused(settings, said):
    with pytest.raises(ValueError, match=said):
        LeaveOneOutRule(*settings)
