"""3DGS-MCMC against its formulas: what moves where, what that looks like, and how faint rows are shaken."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.scene.density import DensityStatistics, GradientDensity, McmcDensity
from sparsestreet.scene.density.mcmc import shared
from sparsestreet.scene.gaussians import RowPlan, Rows
from tests.scene.density.scenes import make_rows
from tests.scene.street import background, degree, random_rows, view_at


def rows_of(opacities: list[float]) -> Rows:
    rows = make_rows(len(opacities), torch.Generator().manual_seed(0))
    with torch.no_grad():
        rows.opacity_logits[:] = torch.tensor(opacities).logit()
    return rows


def densified(rows: Rows, maximum: int | None = None, seed: int = 0, **changes) -> RowPlan:
    return McmcDensity(**changes).densify(
        rows,
        DensityStatistics(len(rows)),
        radius=40.0,
        progress=0.5,
        max_gaussians=maximum,
        generator=torch.Generator().manual_seed(seed),
    )


def test_other_strategies_ask_for_neither_noise_nor_terms():
    rows = rows_of([0.5])
    assert GradientDensity().noise(rows, 0.1, 0) is None
    assert GradientDensity().regularizers(rows) == {}


@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("number", [1, 2, 3, 7, 16])
def test_rows_that_share_a_place_have_the_papers_opacity_and_scale(opacity: float, number: int):
    new = 1 - (1 - opacity) ** (1 / number)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, number + 1)
        for k in range(i)
    )
    log_scales = torch.tensor([[0.1, -1.0, 2.0]], dtype=torch.float64)
    logits = torch.tensor([opacity], dtype=torch.float64).logit()
    logits, scales = shared(logits, log_scales, torch.tensor([number]))
    assert float(torch.sigmoid(logits)) == pytest.approx(new, rel=1e-9)
    # The alternating sum itself loses some digits.
    assert (scales - log_scales).tolist()[0] == pytest.approx([math.log(opacity / total)] * 3, abs=1e-8)


def test_a_thousand_rows_in_one_place_are_finite_and_together_as_opaque():
    logits, scales = shared(torch.tensor([8.0, 20.0]), torch.zeros(2, 3), torch.tensor([1000, 1000]))
    assert bool(logits.isfinite().all() and scales.isfinite().all())
    assert float(1 - (1 - torch.sigmoid(logits[0].double())) ** 1000) == pytest.approx(1 / (1 + math.exp(-8)), abs=1e-5)


def test_the_dead_take_the_place_of_live_ones_and_nobody_else_changes():
    rows = rows_of([0.5, 0.004, 0.5, 0.005, 0.5, 0.0051])
    plan = densified(rows, maximum=6)
    parents = plan.source[[1, 3]].tolist()
    assert set(parents) <= {0, 2, 4, 5}
    assert [plan.source[row].item() for row in (0, 2, 4, 5)] == [0, 2, 4, 5]
    sharing = [row for row in range(6) if plan.source[row].item() in parents]
    assert plan.fresh.nonzero().squeeze(1).tolist() == sharing
    before = {name: column.detach().clone() for name, column in rows.columns().items()}
    rows.resize(plan)
    for name, column in rows.columns().items():
        if name not in ("opacity_logits", "log_scales"):
            assert torch.equal(column, before[name][plan.source])
    counts = [plan.source.tolist().count(source) for source in plan.source.tolist()]
    expected = shared(
        before["opacity_logits"][plan.source], before["log_scales"][plan.source], torch.tensor(counts)
    )  # fmt: skip
    assert torch.equal(rows.opacity_logits, expected[0])
    assert torch.equal(rows.log_scales, expected[1])
    assert (torch.sigmoid(rows.opacity_logits) > 0.005).all()


def test_places_are_drawn_in_proportion_to_opacity():
    dead = 6000
    plan = densified(rows_of([0.1, 0.3, 0.6] + [0.001] * dead), maximum=dead)
    drawn = torch.bincount(plan.source, minlength=3)[:3] - 1
    assert int(drawn.sum()) == dead
    for share, wanted in zip((drawn / dead).tolist(), (0.1, 0.3, 0.6), strict=True):
        # Four standard deviations.
        assert share == pytest.approx(wanted, abs=4 * (wanted * (1 - wanted) / dead) ** 0.5)


@pytest.mark.parametrize(("maximum", "after"), [(None, 105), (200, 105), (103, 103), (100, 100), (90, 100)])
def test_a_node_grows_by_a_share_up_to_its_cap(maximum: int | None, after: int):
    plan = densified(rows_of([0.5] * 100), maximum)
    assert len(plan.source) == after
    assert plan.source[:100].tolist() == list(range(100))
    assert plan.fresh[100:].all()


def test_nothing_is_culled_or_reset_and_where_all_are_dead_nothing_moves():
    rows = rows_of([0.001, 0.5, 0.9])
    everything = [0, 1, 2]
    assert McmcDensity().cull(rows, DensityStatistics(3), radius=1.0, progress=0.5).source.tolist() == everything
    reset = McmcDensity().reset(rows)
    assert (reset.source.tolist(), reset.edits) == (everything, {})
    plan = densified(rows_of([0.001, 0.002]))
    assert (plan.source.tolist(), plan.edits) == ([0, 1], {})
    assert len(densified(rows_of([])).source) == 0


def test_a_generator_decides():
    rows = rows_of([0.5] * 20 + [0.001] * 20)
    assert densified(rows, seed=1).source.tolist() == densified(rows, seed=1).source.tolist()
    assert densified(rows, seed=1).source.tolist() != densified(rows, seed=2).source.tolist()


def test_noise_has_the_covariance_of_the_formula():
    """Sigma eta has covariance Sigma^2: many rows of one shape, at the opacity where the sigmoid is a half."""
    count, rate = 40_000, 1e-3
    rows = rows_of([0.005] * count)
    axes, quaternion = torch.tensor([0.3, 0.1, 0.05]), torch.tensor([0.8, 0.1, -0.5, 0.3])
    with torch.no_grad():
        rows.log_scales[:], rows.quaternions[:] = axes.log(), 2.0 * quaternion  # of any length
    rotation = to_matrix(quaternion)
    sigma = rotation @ torch.diag(axes.square()) @ rotation.T / 4.0**2
    expected = (rate * 2000.0 * 0.5 * sigma) @ (rate * 2000.0 * 0.5 * sigma)
    strategy = McmcDensity(noise_rate=2000.0, unit=4.0)
    noise = strategy.noise(rows, rate, seed=3)
    found = noise.T @ noise / count
    # Sample covariances of n draws are off by about sqrt(2 / n) of the largest, 0.7 %.
    torch.testing.assert_close(found, expected, rtol=0, atol=0.03 * float(expected.max()))
    assert torch.equal(noise, strategy.noise(rows, rate, seed=3))
    assert not torch.equal(noise, strategy.noise(rows, rate, seed=4))


def test_noise_is_for_the_faint():
    opacities = [0.001, 0.005, 0.015, 0.5]
    rows = rows_of(opacities)
    with torch.no_grad():
        rows.log_scales[:], rows.quaternions[:] = 0.0, torch.tensor([1.0, 0, 0, 0])
    strategy = McmcDensity(unit=1.0, noise_rate=1.0)
    size = strategy.noise(rows, 1.0, seed=0) / replace(strategy, sharpness=0.0).noise(rows, 1.0, seed=0)
    expected = torch.tensor([2 / (1 + math.exp(100 * (o - 0.005))) for o in opacities])
    torch.testing.assert_close(size, expected[:, None].expand(4, 3), rtol=1e-4, atol=1e-20)


def test_its_terms_are_the_mean_opacity_and_the_mean_scale():
    rows = rows_of([0.2, 0.6])
    with torch.no_grad():
        rows.log_scales[:] = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 9.0]]).log()
    terms = McmcDensity(opacity_weight=0.5, scale_weight=0.25, unit=2.0).regularizers(rows)
    values = {name: term.item() for name, term in terms.items()}
    assert values == pytest.approx({"mcmc_opacity": 0.5 * 0.4, "mcmc_scale": 0.25 * 4.0 / 2.0}, rel=1e-6)
    assert McmcDensity().regularizers(rows_of([])) == {}


@pytest.mark.parametrize("wrong", [{"growth": -0.1}, {"unit": 0.0}, {"noise_rate": -1.0}, {"scale_weight": -1.0}])
def test_options_out_of_range_are_refused(wrong: dict[str, Any]):
    with pytest.raises(ValueError, match="must be >= 0 and unit > 0"):
        McmcDensity(**wrong)


def test_a_node_adds_the_terms_of_its_strategy_to_the_loss():
    node = background(random_rows(5, 0), density=McmcDensity())
    drawn = torch.ones(5, dtype=torch.bool)
    terms = node.regularizers(view_at(0.0), node.raw_at(view_at(0.0), degree(1)), drawn, degree(1))
    assert terms.keys() == {"mcmc_opacity", "mcmc_scale"}
    torch.stack(tuple(terms.values())).sum().backward()
    assert bool((node.rows.opacity_logits.grad > 0).all() and (node.rows.log_scales.grad > 0).all())
