"""A scene that stands still is activated once, and looks the same as one that is not, whatever happens to it."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene import standing
from sparsestreet.scene.edits import REMOVED, Edits, edited
from sparsestreet.scene.effects import Sky, SkySettings
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.scene.standing import StandingScene
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.training.adam import RowAdam
from sparsestreet.types import Gaussians, Shutter, View
from tests.scene.nodes.test_vibrating import vibrating
from tests.scene.street import background, camera_at, keyframes, pose, random_rows, rigid, static_mask, track, view_at

TIMES = (0.0, 0.37, 0.9, 0.37)
MASK = static_mask(sparsity_weight=0.1)


def street() -> SceneGraph:
    """A road, a car that drives and ends early, trees behind it, a sky; of three degrees."""
    path = keyframes([track("car", [0, 1], [pose(0.0, (0.0, -1.0, 1.0)), pose(0.4, (0.0, 1.0, 1.0))])], 3)
    cars = rigid(random_rows(5, 1, instances=torch.zeros(5, dtype=torch.int64)), path, names=["car"], max_gap=0.2)
    nodes = {
        "road": background(random_rows(13, 0, sh_degree=3)),
        "ground": background(random_rows(6, 3, sh_degree=0)),
        "cars": cars,
        "trees": background(random_rows(7, 2, sh_degree=2)),
    }
    sky = Sky(SkySettings(resolution=4))
    with torch.no_grad():
        sky.texels.uniform_(0, 1, generator=torch.Generator().manual_seed(2))
    return SceneGraph(nodes, {"sky": sky}).eval()


def view(time: float) -> View:
    return view_at(time, camera_at(-6.0, width=17, height=11))


def rolling(time: float) -> View:
    shutter = Shutter(torch.tensor([0.1, 0.0, 0.0]), torch.zeros(3), span=0.1)
    return replace(view(time), camera=replace(view(time).camera, shutter=shutter))


@torch.no_grad()
def frame(scene: SceneGraph, one: View, backend: str = "auto") -> torch.Tensor:
    shown = render(scene, one, options=RenderOptions(backend=backend))
    return torch.cat([shown.rgb.flatten(), shown.depth.flatten(), shown.splats.radii])


def activated_rows(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Fills as rows are activated, one number a call."""
    counts: list[int] = []

    def counting(parts: list[RawGaussians], **options) -> Gaussians:
        counts.append(sum(map(len, parts)))
        return activate(parts, **options)

    activate = standing.activate
    monkeypatch.setattr(standing, "activate", counting)
    monkeypatch.setattr("sparsestreet.scene.graph.activate", counting)
    return counts


def test_frames_are_the_same_to_the_last_bit():
    scene = street()
    stands = StandingScene.of(scene)
    for one in (*map(view, TIMES), *map(rolling, TIMES)):
        assert torch.equal(frame(stands, one), frame(scene, one))
    # In turn with others that share its table: of more rows, of rows of another degree in a place, without the sky.
    more = background(random_rows(9, 4, sh_degree=1))
    variants: list[Callable[[SceneGraph], SceneGraph]] = [
        lambda graph: graph.with_nodes({**graph.nodes, "more": more}),
        lambda graph: graph.without("trees").with_nodes({**graph.without("trees").nodes, "more": more}),
        lambda graph: graph.without("trees"),
        lambda graph: graph.without("road"),
        lambda graph: graph.without("sky"),
        lambda graph: edited(graph, Edits({"car": REMOVED})),
        lambda graph: graph,
    ]
    for time in TIMES:
        for variant in variants:
            assert torch.equal(frame(variant(stands), view(time)), frame(variant(scene), view(time)))


def test_what_stands_still_is_activated_once(monkeypatch: pytest.MonkeyPatch):
    counts = activated_rows(monkeypatch)
    stands = StandingScene.of(street())
    assert StandingScene.of(stands) is stands
    for time in TIMES:
        frame(stands, view(time))
        frame(edited(stands, Edits({"car": REMOVED})), view(time))  # as serve does, for every request
    # Road and ground once; behind them car and trees, whose order a tie of depths can tell.
    assert counts == [19, *[12] * (2 * len(TIMES))]


@pytest.mark.parametrize("node", [vibrating(), background(random_rows(8, 0, mask=MASK), MASK)])
def test_what_follows_the_time_or_a_mask_is_activated_every_time(monkeypatch: pytest.MonkeyPatch, node):
    counts = activated_rows(monkeypatch)
    stands = StandingScene.of(SceneGraph({"only": node}))
    with torch.no_grad():
        found = [stands.gaussians_at(view(time)).gaussians.means.clone() for time in TIMES]
    assert counts == [len(node.rows)] * len(TIMES)
    assert torch.equal(found[0], found[1]) == (node.mask is not None)


def _step(scene: SceneGraph) -> None:
    """One step of the library's Adam, which writes past torch."""
    means = scene.nodes["ground"].rows.means
    means.grad = torch.ones_like(means)
    RowAdam([means], lr=0.3).step()


def _load(scene: SceneGraph) -> None:
    scene.load_state_dict({name: value * 0.9 for name, value in scene.state_dict().items()})


def _set(scene: SceneGraph) -> None:
    with torch.no_grad():
        scene.nodes["ground"].rows.sh_dc[3] += 0.5


def _drop_rows(scene: SceneGraph) -> None:
    scene.nodes["road"].rows.resize(RowPlan.keep(torch.arange(13) != 4))


def _other_parameter(scene: SceneGraph) -> None:
    rows = scene.nodes["road"].rows
    rows.means = torch.nn.Parameter(rows.means.detach() + 0.3)


def _fewer_in_place(scene: SceneGraph) -> None:
    """Other parameters in the same memory."""
    rows = scene.nodes["road"].rows
    for name, column in dict(rows.named_parameters()).items():
        setattr(rows, name, torch.nn.Parameter(column.detach()[:12]))


CHANGES = [_step, _load, _set, _drop_rows, _other_parameter, _fewer_in_place, SceneGraph.double]


@pytest.mark.parametrize("change", CHANGES)
def test_no_change_of_the_parameters_shows_stale_rows(change: Callable[[SceneGraph], None]):
    scene = street()
    stands = StandingScene.of(scene)
    before = frame(stands, view(0.37))
    change(scene)
    after = frame(stands, view(0.37))
    assert torch.equal(after, frame(scene, view(0.37)))
    assert not torch.equal(after.float(), before)


def test_inference_mode_and_frames_after_it():
    scene = street()
    stands = StandingScene.of(scene)
    for inference in (True, False, True):
        with torch.inference_mode(inference):
            assert torch.equal(frame(stands, view(0.37)), frame(scene, view(0.37)))


def test_it_is_shown_and_not_trained():
    stands = StandingScene.of(street())
    with pytest.raises(ValueError, match="shown and not trained, got gradients"):
        stands.gaussians_at(view(0.0))
    with torch.no_grad(), pytest.raises(ValueError, match=r"not trained, got SceneState.*training=True"):
        stands.gaussians_at(view(0.0), replace(FINISHED, training=True))
    with torch.no_grad(), pytest.raises(ValueError, match="sh_degree=1"):
        stands.gaussians_at(view(0.0), SceneState(sh_degree=1))
