"""Who is cloned, split, culled and reset; what the copies inherit."""

import math

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from sparsestreet.scene.density import DensityStatistics, GradientDensity, outside_boxes
from sparsestreet.scene.gaussians import RowPlan, Rows
from tests.scene.density.scenes import make_rows, with_statistics

RADIUS = 10.0  # meters; split_scale 0.003 R = 0.03 m, cull_scale 0.5 R = 5 m
HIGH, LOW = 0.001, 0.0001


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def densified(
    density: GradientDensity,
    rows: Rows,
    statistics: DensityStatistics,
    *,
    seed: int = 0,
    max_gaussians: int | None = None,
    progress: float = 0.5,
) -> RowPlan:
    """By default past the time in which sizes on screen count."""
    return density.densify(
        rows,
        statistics,
        radius=RADIUS,
        progress=progress,
        max_gaussians=max_gaussians,
        generator=seeded(seed),
    )


def rows_of_scales(largest: list[float]) -> Rows:
    rows = make_rows(len(largest), seeded())
    with torch.no_grad():
        rows.log_scales.copy_(torch.tensor(largest).log()[:, None] - torch.tensor([1.0, 0.0, 2.0]))
    return rows


# Rows: 0 small and still, 1 small and wanted, 2 large and still, 3 large and wanted, 4 small but large on screen.
SCALES = [0.02, 0.02, 0.04, 0.04, 0.02]
STATISTICS = ([LOW, HIGH, LOW, HIGH, HIGH], [0.0, 0.0, 0.9, 0.0, 0.06])


@pytest.mark.parametrize(
    ("keep_parent", "use_screen_size", "source", "num_survivors"),
    [
        (True, True, [0, 1, 2, 3, 4, 1, 3, 3, 4, 4], 5),
        (True, False, [0, 1, 2, 3, 4, 1, 4, 3, 3], 5),
        (False, True, [0, 1, 2, 1, 3, 3, 4, 4], 3),
        (False, False, [0, 1, 2, 4, 1, 4, 3, 3], 4),
    ],
)
def test_small_rows_are_cloned_and_large_ones_split(keep_parent, use_screen_size, source, num_survivors):
    density = GradientDensity(keep_parent=keep_parent, screen_size_until=0.3)
    progress = 0.3 if use_screen_size else 0.31
    plan = densified(density, rows_of_scales(SCALES), with_statistics(*STATISTICS), progress=progress)
    assert plan.source.tolist() == source
    assert plan.fresh.tolist() == [row >= num_survivors for row in range(len(source))]


def test_a_row_of_just_the_split_scale_is_cloned():
    """3DGS: split above, clone up to it."""
    plan = densified(GradientDensity(split_scale=1 / RADIUS), rows_of_scales([1.0]), with_statistics([HIGH]))
    assert plan.edits["log_scales"].amax(1).tolist() == [0.0, 0.0]


def test_columns_of_survivors_clones_and_children():
    rows = rows_of_scales(SCALES)
    before = {name: column.detach().clone() for name, column in rows.columns().items()}
    plan = densified(GradientDensity(), rows, with_statistics(*STATISTICS))
    rows.resize(plan)
    source = torch.tensor([0, 1, 2, 3, 4, 1, 4, 3, 3])
    for name in ("quaternions", "opacity_logits", "sh_dc", "sh_rest", "mask_logits", "instances"):
        assert torch.equal(rows.columns()[name], before[name][source]), name
    assert torch.equal(rows.means[:7], before["means"][source[:7]])  # only children move
    shrink = torch.tensor([0, 0, 0, 1, 0, 0, 0, 1, 1]) * math.log(1.6)  # the kept parent and its children
    torch.testing.assert_close(rows.log_scales, before["log_scales"][source] - shrink[:, None])
    assert not torch.equal(rows.means[7], rows.means[8])


def test_children_are_drawn_from_their_parent():
    """Mean and covariance of many children against R diag(s^2) R^T from another library's rotations."""
    children = 40_000
    scales = torch.tensor([[0.5, 0.1, 0.02]])
    quaternion = torch.tensor([[0.3, -0.5, 0.7, 0.2]]) * 3  # not unit
    rows = Rows(
        {
            "means": torch.tensor([[1.0, 2.0, 3.0]]),
            "log_scales": scales.log(),
            "quaternions": quaternion,
            "opacity_logits": torch.zeros(1),
        }
    )
    density = GradientDensity(split_children=children, keep_parent=False)
    means = densified(density, rows, with_statistics([HIGH])).edits["means"].double()
    rotation = Rotation.from_quat(quaternion[0, [1, 2, 3, 0]].double().numpy()).as_matrix()
    whitened = (means - torch.tensor([1.0, 2.0, 3.0])) @ torch.from_numpy(rotation) / scales[0]
    # Standard errors: 1/sqrt(N) = 0.005 of the mean, sqrt(2/N) = 0.007 of a variance; four of each.
    torch.testing.assert_close(whitened.mean(0), torch.zeros(3).double(), atol=0.02, rtol=0)
    torch.testing.assert_close(torch.cov(whitened.T), torch.eye(3).double(), atol=0.03, rtol=0)


def test_the_same_seed_gives_the_same_children_and_another_other_ones():
    rows, statistics = rows_of_scales(SCALES), with_statistics(*STATISTICS)
    first, same, other = (
        densified(GradientDensity(), rows, statistics, seed=seed).edits["means"] for seed in (1, 1, 2)
    )
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("maximum", "grown"),
    # By gradient: row 4 (split, +2), row 2 (clone, +1), row 1 (clone, +1, tie with 3), row 3 (split, +2).
    [
        (4, []),
        (6, []),
        (7, [4, 4]),
        (8, [2, 4, 4]),
        (9, [1, 2, 4, 4]),
        (10, [1, 2, 4, 4]),
        (11, [1, 2, 3, 3, 4, 4]),
    ],
)
def test_a_cap_takes_the_highest_gradients(maximum, grown):
    rows = rows_of_scales([0.02, 0.02, 0.02, 0.04, 0.04])
    statistics = with_statistics([LOW, HIGH, 2 * HIGH, HIGH, 3 * HIGH])
    plan = densified(GradientDensity(), rows, statistics, max_gaussians=maximum)
    assert plan.source.tolist() == [0, 1, 2, 3, 4, *grown]
    assert len(plan.source) <= max(maximum, 5)


def test_a_cap_counts_a_replaced_parent_as_room():
    density = GradientDensity(keep_parent=False)
    plan = densified(density, rows_of_scales([0.04, 0.04]), with_statistics([HIGH, HIGH]), max_gaussians=3)
    assert plan.source.tolist() == [1, 0, 0]


def test_cull_drops_faint_huge_and_close_rows():
    rows = rows_of_scales([0.1, 0.1, 6.0, 0.1, 0.1])
    opacities = torch.tensor([0.0049, 0.0051, 0.5, 0.5, 0.5])
    with torch.no_grad():
        rows.opacity_logits.copy_(torch.logit(opacities))
    statistics = with_statistics([0.0] * 5, screens=[0.0, 0.0, 0.0, 0.2, 0.1])

    def kept(use_scale: bool, use_screen: bool) -> list[int]:
        density = GradientDensity(
            cull_scale_from=0.39 if use_scale else 0.4, screen_size_until=0.4 if use_screen else 0.39
        )
        return density.cull(rows, statistics, radius=RADIUS, progress=0.4).source.tolist()

    assert kept(False, False) == [1, 2, 3, 4]
    assert kept(True, False) == [1, 3, 4]
    # What is large on screen goes only once what is large in the world does, as in DriveStudio.
    assert kept(False, True) == [1, 2, 3, 4]
    assert kept(True, True) == [1, 4]


def test_outside_boxes_measures_in_the_box_of_each_instance():
    sizes = torch.tensor([[4.0, 2.0, 1.5], [0.6, 0.6, 1.8]])
    means = torch.tensor([[1.9, 0.9, 0.7], [1.9, 0.9, 0.7], [-2.05, 0, 0], [-2.15, 0, 0], [0, 0, -0.95], [0, -0.45, 0]])
    instances = torch.tensor([0, 1, 0, 0, 1, 1])
    assert outside_boxes(means, instances, sizes, margin=0.1).tolist() == [False, True, False, True, False, True]
    none = outside_boxes(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), sizes, margin=0.0)
    assert none.shape == (0,)


def test_reset_lowers_opacities_only_where_they_are_higher():
    rows = make_rows(4, seeded())
    with torch.no_grad():
        rows.opacity_logits.copy_(torch.logit(torch.tensor([0.005, 0.01, 0.5, 0.999])))
    before = rows.opacity_logits.detach().clone()
    rows.resize(GradientDensity(reset_opacity_to=0.01).reset(rows))
    assert torch.equal(rows.opacity_logits[:1], before[:1])
    # float32 logit and sigmoid round to about 1e-7 relative
    torch.testing.assert_close(rows.opacity_logits.sigmoid()[1:], torch.full((3,), 0.01), rtol=1e-6, atol=0)
    for impossible in (0.0, 1.0):
        with pytest.raises(ValueError, match="between 0 and 1"):
            GradientDensity(reset_opacity_to=impossible)


@pytest.mark.lengthy
@settings(max_examples=100, deadline=None)
@given(st.data())
def test_plans_are_well_formed(data):
    number = data.draw(st.integers(0, 9))
    gradients = data.draw(st.lists(st.sampled_from([LOW, HIGH, 5 * HIGH]), min_size=number, max_size=number))
    density = GradientDensity(
        split_children=data.draw(st.integers(2, 4)),
        keep_parent=data.draw(st.booleans()),
        cull_scale_from=0.0,
        screen_size_until=0.5,
    )
    max_gaussians = data.draw(st.none() | st.integers(0, 20))
    rows = make_rows(number, seeded(number), scale=0.03)
    statistics = with_statistics(gradients)
    progress = 0.3 if data.draw(st.booleans()) else 0.7
    plan = densified(density, rows, statistics, max_gaussians=max_gaussians, progress=progress)
    survivors, copies = plan.source[~plan.fresh].tolist(), plan.source[plan.fresh].tolist()
    assert all(0 <= row < number for row in plan.source.tolist())
    assert survivors == sorted(set(survivors))  # each once, in order
    assert plan.source.tolist() == survivors + copies
    assert set(range(number)) == set(survivors) | set(copies)  # nobody vanishes: a replaced parent leaves children
    assert all(gradients[row] > density.grad_threshold for row in copies)
    if max_gaussians is not None:
        assert len(plan.source) <= max(number, max_gaussians)
    rows.resize(plan)
    statistics.resize(plan)
    culled = density.cull(rows, statistics, radius=RADIUS, progress=0.4).source.tolist()
    assert culled == sorted(set(culled))
    assert all(0 <= row < len(rows) for row in culled)
    assert all(column.isfinite().all() for column in rows.columns().values())


def test_statistics_of_other_rows_are_refused():
    rows = make_rows(3, seeded())
    with pytest.raises(ValueError, match="3 rows but its statistics 2"):
        densified(GradientDensity(), rows, DensityStatistics(2))
    with pytest.raises(ValueError, match="3 rows but its statistics 2"):
        GradientDensity().cull(rows, DensityStatistics(2), radius=RADIUS, progress=0.5)


def test_impossible_settings_are_refused():
    with pytest.raises(ValueError, match="split_children=1"):
        GradientDensity(split_children=1)
    with pytest.raises(ValueError, match="split_shrink"):
        GradientDensity(split_shrink=0.5)


def test_a_parent_that_became_small_is_cloned_too():
    """DriveStudio splits before it clones: 0.03 < 0.04 <= 0.048, but 0.06 / 1.6 = 0.0375 stays large."""
    rows = rows_of_scales([0.02, 0.04, 0.06])
    plan = densified(GradientDensity(clone_shrunk=True), rows, with_statistics([HIGH] * 3))
    assert plan.source.tolist() == [0, 1, 2, 0, 1, 1, 1, 2, 2]
    scales = plan.edits["log_scales"].amax(1).exp()
    expected = torch.tensor([0.02, 0.025, 0.0375, 0.02, 0.025, 0.025, 0.025, 0.0375, 0.0375])
    torch.testing.assert_close(scales, expected)
    assert torch.equal(plan.edits["means"][[1, 4]], rows.means.detach()[[1, 1]])
    # Four rows come of row 1: with room for three, it does not grow.
    capped = densified(GradientDensity(clone_shrunk=True), rows, with_statistics([LOW, HIGH, LOW]), max_gaussians=5)
    assert capped.source.tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="clones parents that stay"):
        GradientDensity(clone_shrunk=True, keep_parent=False)


def test_a_row_that_is_small_but_large_on_screen_is_split_and_cloned():
    density = GradientDensity(clone_shrunk=True, screen_size_until=0.5)
    plan = densified(density, rows_of_scales([0.02]), with_statistics([HIGH], [0.06]))
    assert plan.source.tolist() == [0, 0, 0, 0]
