"""Probabilities of existence: what is drawn, its gradient, what the loss lowers, and what never shows and goes."""

from dataclasses import replace

import pytest
import torch
from scipy.integrate import quad
from scipy.special import expit

from sparsestreet.ops import SplatSettings, splat
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import Mask, MaskSettings, SampledMask, SampledMaskSettings
from sparsestreet.scene.rendering import RenderOptions, from_another_camera, render
from sparsestreet.scene.state import FINISHED, SceneState
from tests.training.stubs import background, frame_at, set_rows

SETTINGS = SampledMaskSettings(5e-4)
STEP_7 = SceneState(progress=0.5, training=True, step=7)
EVERY = torch.ones(0, dtype=torch.bool)
"""Which rows a view draws, for masks that do not ask."""
MANY = 20_000
ERROR = 4 * 0.5 / MANY**0.5
"""Four standard deviations of a share of as many rows."""


def rows_of(*logits: float) -> Rows:
    return Rows({"mask_logits": torch.tensor(logits)}, transient=["mask_logits"])


def alike(logit: float, count: int = MANY) -> Rows:
    return rows_of(*[logit] * count)


def test_the_contract():
    mask = SETTINGS.build(min_gaussians=3)
    assert isinstance(SETTINGS, MaskSettings)
    assert isinstance(mask, Mask)
    assert mask.min_gaussians == 3
    columns = mask.initial_columns(5)
    assert tuple(columns) == mask.columns
    assert torch.equal(columns["mask_logits"], torch.full((5,), 3.0))
    assert mask.finish(rows_of(0.0)) == (None, {})
    # What a resumed run needs follows from the step.
    assert not mask.state_dict()


@pytest.mark.parametrize("logit", [-2.0, 0.0, 3.0])
def test_rows_are_sampled_as_often_as_their_probability_says(logit):
    gates = SETTINGS.build(0).gates(alike(logit), step=1)
    assert set(gates.tolist()) == {0.0, 1.0}
    assert float(gates.detach().mean()) == pytest.approx(float(expit(logit)), abs=ERROR)


@pytest.mark.parametrize("temperature", [1.0, 0.5])
def test_the_gradient_is_that_of_the_softmax(temperature):
    """On average over the noise, whose density is the logistic one; by quadrature."""
    mask, rows = replace(SETTINGS, temperature=temperature).build(0), alike(1.0)
    mask.gates(rows, step=1).sum().backward()

    def slope(noise: float) -> float:
        soft, density = expit((1.0 + noise) / temperature), expit(noise) * expit(-noise)
        return soft * (1 - soft) / temperature * density

    expected, _ = quad(slope, -40, 40)
    # A slope lies in [0, 1 / (4 tau)], so its standard deviation is below 1 / (8 tau).
    assert float(rows.mask_logits.grad.mean()) == pytest.approx(expected, abs=ERROR / 4 / temperature)


def test_samples_depend_on_seed_and_step_alone():
    rows = alike(0.0, 60)
    first = SETTINGS.build(0)
    drawn = [first.gates(rows, step) for step in (5, 6)]
    kept = first.keep(rows).keep
    assert not torch.equal(*drawn)
    resumed = SETTINGS.build(0)
    assert torch.equal(resumed.gates(rows, 6), drawn[1])
    assert torch.equal(resumed.keep(rows).keep, kept)
    assert not torch.equal(replace(SETTINGS, seed=1).build(0).gates(rows, 6), drawn[1])


def test_the_loss_is_the_squared_mean_of_what_was_drawn():
    mask, rows = SETTINGS.build(0), alike(0.5, 60)
    gates = mask.gates(rows, step=3)
    loss = mask.sparsity(rows, 0.0, EVERY)
    assert loss.item() / 60 == pytest.approx(gates.mean().item() ** 2, rel=1e-6)
    (of_loss,) = torch.autograd.grad(loss / 60, rows.mask_logits)
    (of_gates,) = torch.autograd.grad(gates.sum(), rows.mask_logits)
    # d (mean M)^2 = 2 mean M dM / n
    torch.testing.assert_close(of_loss, 2 * gates.mean().detach() * of_gates / 60, rtol=1e-5, atol=1e-9)


def test_only_visible_rows_are_pushed_where_the_mask_says_so():
    mask, rows = replace(SETTINGS, visible_only=True).build(0), alike(0.5, 60)
    mask.gates(rows, step=3)
    visible = torch.arange(60) % 2 == 0
    mask.sparsity(rows, 0.0, visible).backward()
    assert torch.equal(rows.mask_logits.grad > 0, visible)


def test_what_none_of_the_draws_samples_goes():
    """A row of p = 0.1 is in none of ten draws with probability 0.9^10."""
    mask, rows = SETTINGS.build(0), alike(-2.1972246)
    mask.gates(rows, step=1)
    selection = mask.keep(rows)
    assert float(selection.keep.float().mean()) == pytest.approx(1 - 0.9**10, abs=ERROR)
    once = replace(SETTINGS, draws=1).build(0).keep(rows)
    assert float(once.keep.float().mean()) == pytest.approx(0.1, abs=ERROR)
    assert not SETTINGS.build(0).keep(alike(40.0, 9)).removed


def test_the_floor_holds_in_every_step_and_when_rows_go():
    mask = SETTINGS.build(min_gaussians=4)
    rows = rows_of(-20.0, -24.0, -19.0, -22.0, -21.0, -23.0, 9.0)
    for step in range(5):
        assert int(mask.gates(rows, step).sum()) == 4
    assert int(mask.floor_firings) == 5
    selection = mask.keep(rows)
    assert selection.keep.tolist() == [True, False, True, False, True, False, True]
    assert selection.floor_hit
    # A floor above all rows opens all.
    assert SETTINGS.build(99).gates(rows, 0).tolist() == [1.0] * 7


def test_a_training_step_hides_rows_that_other_views_show_and_tells_them_what_they_would_do():
    node, other = background(12, mask=SETTINGS), background(5, seed=1)
    set_rows(node, "mask_logits", dict.fromkeys(range(12), 0.0))
    scene = SceneGraph({"street": node, "other": other})
    options = RenderOptions(settings=SplatSettings(alpha_min=0.0, transmittance_min=0.0))
    rendering = render(scene, frame_at(), STEP_7, options)
    gates = rendering.gates
    assert gates.shape == (17,)
    assert torch.equal(gates[12:], torch.ones(5))
    assert 0 < int(gates.sum()) - 5 < 12
    hidden = (gates[:12] == 0) & rendering.splats.visible[:12]
    assert hidden.any()
    rendering.rgb.square().sum().backward()
    assert (node.rows.mask_logits.grad[rendering.splats.visible[:12]] != 0).all()
    assert not node.rows.means.grad[hidden].any()
    finished = render(scene, frame_at(), FINISHED, options)
    assert finished.gates is None
    assert not torch.equal(finished.rgb, rendering.rgb)
    node.finish_mask()
    assert torch.equal(render(scene, frame_at(), FINISHED, options).rgb, finished.rgb)
    assert render(scene, frame_at(), STEP_7, options).gates is None


def test_triton_gets_the_samples(monkeypatch):
    """Its kernels draw with them in tests/ops/triton/test_gates.py; here the reference draws what they are given."""
    kernels = pytest.importorskip("sparsestreet.ops.triton.rasterizer")
    given = []

    def drawn(gaussians, offsets, background, camera, settings, gates, changes, replay):
        assert (changes, replay) == (None, False)
        given.append(gates)
        return splat(gaussians, camera, background=background, settings=settings, backend="reference", gates=gates)

    monkeypatch.setattr(kernels, "render", drawn)
    node = background(12, mask=SETTINGS)
    set_rows(node, "mask_logits", dict.fromkeys(range(12), 0.0))
    scene, options = SceneGraph({"street": node}), RenderOptions(backend="triton")
    rendering = render(scene, frame_at(), STEP_7, options)
    assert given[0] is rendering.gates
    assert 0 < int(rendering.gates.sum()) < 12
    rendering.rgb.square().sum().backward()
    assert node.rows.mask_logits.grad[rendering.gates == 0].any()
    render(scene, frame_at(), FINISHED, options)
    assert given[1:] == [None]


def test_another_camera_of_the_same_step_sees_the_same_samples():
    node = background(12, mask=SETTINGS)
    set_rows(node, "mask_logits", dict.fromkeys(range(12), 0.0))
    rendering = render(scene := SceneGraph({"street": node}), frame_at(), STEP_7)
    again = from_another_camera(scene, rendering, frame_at(), rendering.options)
    assert torch.equal(again.rgb, rendering.rgb)


def test_no_rows():
    mask = SampledMask(SETTINGS)
    assert mask.gates(rows_of(), 0).shape == (0,)
    assert mask.sparsity(rows_of(), 0.0, EVERY).item() == 0
    assert mask.keep(rows_of()).removed == 0
