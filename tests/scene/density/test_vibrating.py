"""Where PVG grows Gaussians beside those of 3DGS, and when and where their children peak."""

import math

import pytest
import torch

from sparsestreet.scene.density import DensityStatistics, VibratingDensity
from sparsestreet.scene.gaussians import RowPlan, Rows
from tests.scene.density.scenes import make_rows

CYCLE = 0.2


def vibrating_rows(means: torch.Tensor, largest: list[float]) -> Rows:
    count = len(means)
    columns = dict(make_rows(count, torch.Generator().manual_seed(0)).named_parameters())
    columns |= {
        "means": means,
        "log_scales": torch.tensor(largest).log()[:, None].expand(count, 3),
        "velocities": torch.arange(3.0 * count).reshape(count, 3),
        "life_peaks": torch.linspace(0, 1, count),
        "log_life_spans": torch.linspace(-2, -1, count),
    }
    return Rows(columns)


def statistics_of(gradients: list[float], peaks: list[float]) -> DensityStatistics:
    statistics = DensityStatistics(len(gradients), watched=VibratingDensity.watched)
    statistics.add(
        torch.tensor(gradients)[:, None] * torch.tensor([[1.0, 0.0]]),
        torch.ones(len(gradients)),
        2,
        2,
        {"life_peaks": torch.tensor(peaks)},
    )
    return statistics


def densified(
    rows: Rows, statistics: DensityStatistics, maximum: int | None = None, seed: int = 0, **changes
) -> RowPlan:
    return VibratingDensity(grad_threshold=0.1, peak_threshold=0.01, split_scale=0.01, **changes).densify(
        rows,
        statistics,
        radius=40.0,
        progress=0.5,
        max_gaussians=maximum,
        generator=torch.Generator().manual_seed(seed),
    )


def test_either_gradient_asks_for_more_the_most_urgent_first():
    rows = vibrating_rows(torch.zeros(5, 3), [0.001] * 5)
    # Urgency 0.9, 1.1 (screen), 3 (peak, of either sign), 2 (both), 0.
    statistics = statistics_of([0.09, 0.11, 0.0, 0.2, 0.0], [0.0, 0.0, -0.03, 0.015, 0.0])
    # A small row is cloned; with a gradient of its peak, and a long life, it is also split.
    assert densified(rows, statistics).source.tolist() == [0, 1, 2, 3, 4, 1, 2, 3, 2, 2, 3, 3]
    assert densified(rows, statistics, maximum=7).source.tolist() == [0, 1, 2, 3, 4]
    assert densified(rows, statistics, maximum=8).source.tolist() == [0, 1, 2, 3, 4, 2, 2, 2]
    assert densified(rows, statistics, maximum=11).source.tolist() == [0, 1, 2, 3, 4, 2, 3, 2, 2, 3, 3]


@pytest.mark.parametrize(
    ("gradient", "peak", "scale", "span", "clones", "children"),
    [
        (1.0, 0.0, 0.009, 0.3, 1, 0),
        (1.0, 0.0, 0.011, 0.3, 0, 2),
        (1.0, 0.0, 0.009, 0.009, 1, 0),
        (0.0, 1.0, 0.009, 0.3, 1, 2),
        (0.0, 1.0, 0.011, 0.3, 0, 2),
        (0.0, 1.0, 0.009, 0.009, 1, 0),
        (0.0, 1.0, 0.011, 0.009, 1, 2),
        (0.0, 0.0, 0.011, 0.3, 0, 0),
    ],
    ids=[
        "in space, small: cloned",
        "in space, large: split",
        "in space a short life counts for nothing",
        "in time, small, long: cloned and split",
        "in time, large, long: split by either",
        "in time, small, short: cloned by either",
        "in time, large, short: split and cloned",
        "without gradients",
    ],
)
def test_space_clones_what_is_small_and_time_splits_what_lives_long(gradient, peak, scale, span, clones, children):
    """One row in the middle: its limits are 1 % of 1 m in space and 0.01 in time."""
    rows = vibrating_rows(torch.zeros(1, 3), [scale])
    with torch.no_grad():
        rows.log_life_spans.fill_(math.log(span))
    peaks = rows.life_peaks.detach().clone()
    plan = densified(rows, statistics_of([gradient], [peak]))
    assert len(plan.source) == 1 + clones + children
    assert plan.fresh.tolist() == [False] + [True] * (clones + children)
    rows.resize(plan)
    # Whatever is split shrinks, and its clone with it; nobody's life is shortened.
    shrunk = scale / 1.6 if children else scale
    torch.testing.assert_close(rows.log_scales.exp(), torch.full_like(rows.log_scales, shrunk))
    torch.testing.assert_close(rows.log_life_spans.exp(), torch.full((len(rows),), span))
    assert (rows.life_peaks == peaks).tolist() == [True] * (1 + clones) + [False] * children


def test_far_rows_may_be_larger_before_they_are_split_or_culled():
    """The median of the means is (10, 0, 0) and R = 40 m: units of 1 m (at 0.04 m), 19 m (0.5 m) and 799 m (20 m)."""
    means = torch.tensor([[10.0, 0.0, 0.0], [10.0, 0.0, 0.04], [10.0, 0.5, 0.0], [10.0, -0.5, 0.0], [30.0, 0.0, 0.0]])
    means = torch.cat((means, torch.tensor([[-10.0, 0.0, 0.0], [10.0, 0.0, 0.0]])))
    rows = vibrating_rows(means, [0.009, 0.011, 0.189, 0.191, 7.98, 8.0, 0.009])
    plan = densified(rows, statistics_of([1.0] * 7, [0.0] * 7))
    assert plan.source[7:].tolist() == [0, 2, 4, 6, 1, 1, 3, 3, 5, 5]
    rows = vibrating_rows(means, [0.49, 0.51, 9.4, 9.6, 399.0, 400.0, 0.49])
    with torch.no_grad():
        rows.opacity_logits.fill_(0.0)
    culled = VibratingDensity(cull_scale=0.5).cull(rows, statistics_of([1.0] * 7, [0.0] * 7), radius=40.0, progress=0.5)
    assert culled.source.tolist() == [0, 2, 4, 6]


@pytest.mark.parametrize(("gradient", "change"), [(1.0, 0.0), (0.0, 1.0)], ids=["split in space", "split in time"])
def test_children_peak_within_their_parents_life_and_lie_where_it_takes_them(gradient, change):
    children = 40_000
    mean, velocity, peak, span = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[5.0, 0.0, -1.0]]), 0.4, 0.1
    rows = vibrating_rows(mean, [0.5])
    with torch.no_grad():
        rows.log_scales.fill_(math.log(1e-6))  # nothing but the motion
        rows.velocities.copy_(velocity)
        rows.life_peaks.fill_(peak)
        rows.log_life_spans.fill_(math.log(span))
    density = VibratingDensity(grad_threshold=0.1, split_scale=1e-9, split_children=children, keep_parent=False)
    plan = density.densify(
        rows,
        statistics_of([gradient], [change]),
        radius=1.0,
        progress=0.5,
        max_gaussians=None,
        generator=torch.Generator().manual_seed(3),
    )
    peaks = plan.edits["life_peaks"]
    # Standard errors: 0.1 / sqrt(N) = 5e-4 of the mean, 0.1 / sqrt(2 N) = 3.5e-4 of the deviation; four of each.
    assert float(peaks.mean()) == pytest.approx(peak, abs=2e-3)
    assert float(peaks.std()) == pytest.approx(span, abs=1.4e-3)
    average = velocity * math.exp(-0.5 * span / CYCLE)
    expected = mean + (peaks - peak)[:, None] * average
    torch.testing.assert_close(plan.edits["means"], expected, rtol=0, atol=1e-5)  # scales of 1e-6 m, five of them
    rows.resize(plan)
    assert torch.equal(rows.velocities, velocity.expand(children, 3))
    assert torch.equal(rows.log_life_spans, torch.full((children,), span).log())


def test_parents_and_clones_keep_their_time():
    rows = vibrating_rows(torch.zeros(3, 3), [0.001, 0.5, 0.001])
    peaks, means = rows.life_peaks.detach().clone(), rows.means.detach().clone()
    plan = densified(rows, statistics_of([1.0, 1.0, 0.0], [0.0] * 3))
    assert plan.source.tolist() == [0, 1, 2, 0, 1, 1]
    rows.resize(plan)
    assert torch.equal(rows.life_peaks[:4], peaks[plan.source[:4]])
    assert torch.equal(rows.means[:4], means[plan.source[:4]])
    assert (rows.life_peaks[4:] != peaks[1]).all()


def test_the_same_seed_gives_the_same_children():
    rows, statistics = vibrating_rows(torch.zeros(2, 3), [0.5, 0.5]), statistics_of([1.0, 1.0], [0.0, 0.0])
    first, same, other = (densified(rows, statistics, seed=seed).edits["life_peaks"] for seed in (1, 1, 2))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_a_node_without_rows():
    rows = vibrating_rows(torch.zeros(0, 3), [])
    assert len(densified(rows, statistics_of([], [])).source) == 0
