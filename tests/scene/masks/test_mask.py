"""What every mask answers, and what a node does with it: the static one, and one that depends on time."""

from dataclasses import replace
from math import nan

import pytest
import torch
from torch import Tensor

from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import Mask, SampledMaskSettings, StaticMask, StaticMaskSettings, TemporalMaskSettings
from sparsestreet.scene.nodes import Background
from tests.scene.masks.stub import RisingMask, RisingSettings
from tests.scene.street import (
    NUM_FRAMES,
    RATES,
    background,
    background_settings,
    degree,
    random_rows,
    static_mask,
    training_data,
    view_at,
)
from tests.typed import as_a

KINDS = StaticMaskSettings, TemporalMaskSettings, SampledMaskSettings
MASKS = {"static": static_mask, "rising": RisingMask}
both = pytest.mark.parametrize("make", MASKS.values(), ids=MASKS.keys())


def masked(mask: Mask, count: int = 9) -> Background:
    """Some rows are closed at every time."""
    node = background(random_rows(count, 0, mask=mask), mask)
    with torch.no_grad():
        if isinstance(mask, StaticMask):
            node.rows.mask_logits[::3] = -7.0
        else:
            node.rows.dawn[::3] = 1.5
    return node


def opacities(node: Background, time: float) -> Tensor:
    return node.gaussians_at(view_at(time), degree(1)).opacities


@both
def test_columns_are_made_for_a_table_and_named(make: type[Mask]):
    mask = make()
    columns = mask.initial_columns(5)
    assert tuple(columns) == mask.columns
    assert {column.shape for column in columns.values()} == {(5,)}
    assert {column.shape for column in mask.initial_columns(0).values()} == {(0,)}


@both
@pytest.mark.parametrize("time", [0.0, 0.45, 1.0])
def test_multipliers_are_0_or_1_and_their_gradient_is_that_of_the_scores(make: type[Mask], time: float):
    node = masked(make())
    multipliers = node.mask.multipliers(node.rows, time)
    assert set(multipliers.tolist()) <= {0.0, 1.0}
    multipliers.sum().backward()
    assert all((getattr(node.rows, name).grad != 0).any() for name in node.mask.columns)
    loss = node.mask.sparsity(node.rows, time, torch.ones(9, dtype=torch.bool))
    assert loss.shape == ()
    assert loss.item() > 0
    loss.backward()


@both
def test_what_is_kept_shows_at_some_time_and_what_goes_at_none(make: type[Mask]):
    node = masked(make())
    shown = torch.stack([node.mask.multipliers(node.rows, time) > 0 for time in (0.0, 1.0)]).any(0)
    selection = node.mask.keep(node.rows)
    assert torch.equal(selection.keep, shown)
    assert 0 < selection.removed < 9
    before = [opacities(node, time)[selection.keep] for time in (0.0, 0.45, 1.0)]
    node.rows.resize(selection.plan())
    assert all(map(torch.equal, before, [opacities(node, time) for time in (0.0, 0.45, 1.0)]))


def test_a_mask_over_time_hides_a_row_now_and_shows_it_later():
    node = masked(RisingMask())
    counts = [int((opacities(node, time) > 0).sum()) for time in (0.0, 0.45, 1.0)]
    assert counts[0] == 0 < counts[1] < counts[2] < 9


@both
def test_the_floor_holds(make: type[Mask]):
    mask = make(min_gaussians=8)
    selection = mask.keep(masked(mask).rows)
    assert int(selection.keep.sum()) == 8
    assert selection.floor_hit


@both
def test_a_node_is_built_with_its_mask(make: type[Mask]):
    """The settings of the mask are asked with K_min of the node and the times of the training frames."""
    wanted = StaticMaskSettings(0.5) if make is static_mask else RisingSettings(0.5)
    settings = background_settings(lidar=50, mask=wanted, masked=True, min_gaussians=7)
    node = settings.build(training_data(held_out=frozenset({2})), torch.Generator().manual_seed(0))
    assert node.rows.transient == set(node.mask.columns)
    assert node.mask.min_gaussians == 7
    assert node.mask.sparsity_weight == 0.5
    if make is RisingMask:
        times = tuple(training_data(held_out=frozenset({2})).times)
        assert as_a(RisingSettings, wanted).built_with == [(7, times)]
        assert len(times) == NUM_FRAMES - 1
    unmasked = replace(settings, masked=False)
    assert unmasked.mask_settings is None
    assert unmasked.build(training_data(), torch.Generator().manual_seed(0)).mask is None


def test_the_parameters_of_a_mask_are_those_of_its_node():
    node = masked(RisingMask())
    names = {name for name, _ in node.named_parameters()}
    assert {"mask.net.weight", "mask.net.bias", "rows.dawn", "rows.slope"} <= names
    node.settings = replace(node.settings, learning_rates={**RATES, "mask": RATES["means"], "dawn": RATES["means"]})
    with pytest.raises(ValueError, match=r"'rows.slope' has no learning rate: add one to node.road"):
        SceneGraph({"road": node}).learning_rates()


@both
def test_rows_of_a_finished_mask_are_unmasked(make: type[Mask]):
    node = masked(make())
    node.rows.resize(node.mask.keep(node.rows).plan())
    expected = opacities(node, 1.0)
    node.finish_mask()
    assert node.mask is None
    assert torch.equal(opacities(node, 0.0), expected)  # M = 1 at all times
    assert not set(node.rows.columns()) & node.rows.transient
    assert not [name for name, _ in node.named_parameters() if "mask" in name]


@both
def test_a_checkpoint_from_after_the_mask_stage_loads_into_a_masked_node(make: type[Mask]):
    """A run that is resumed builds its nodes anew, with masks; the checkpoint says that they are over."""
    finished = masked(make())
    finished.rows.resize(finished.mask.keep(finished.rows).plan())
    finished.finish_mask()
    fresh = SceneGraph({"road": masked(make(), count=4)})
    fresh.load_state_dict(SceneGraph({"road": finished}).state_dict())
    road = as_a(Background, fresh.nodes["road"])
    assert road.mask is None
    assert len(road.rows) == len(finished.rows) != 4
    assert road.rows.columns().keys() == finished.rows.columns().keys()
    assert torch.equal(opacities(road, 0.0), opacities(finished, 0.0))
    assert all(parameter.requires_grad for parameter in fresh.parameters())
    assert road.row_bytes() == finished.row_bytes()


@both
def test_a_checkpoint_from_the_mask_stage_brings_the_mask_along(make: type[Mask]):
    saved, fresh = masked(make()), masked(make(), count=4)
    if make is RisingMask:
        with torch.no_grad():
            as_a(RisingMask, saved.mask).net.bias.fill_(0.2)
    fresh.load_state_dict(saved.state_dict())
    assert isinstance(fresh.mask, Mask)
    for time in (0.0, 0.45, 1.0):
        assert torch.equal(opacities(fresh, time), opacities(saved, time))


def test_only_visible_rows_are_pushed_where_the_mask_says_so():
    rows = Rows({"mask_logits": torch.tensor([0.0, 2.0, -1.0])}, transient=["mask_logits"])
    visible = torch.tensor([True, False, True])
    scores = torch.sigmoid(torch.tensor([0.0, 2.0, -1.0]))
    for visible_only, counted in ((False, torch.ones(3)), (True, visible.float())):
        mask = static_mask(visible_only=visible_only)
        loss = mask.sparsity(rows, 0.5, visible)
        torch.testing.assert_close(loss.detach(), (scores * counted).sum())
        (gradient,) = torch.autograd.grad(loss, rows.mask_logits)
        torch.testing.assert_close(gradient, scores * (1 - scores) * counted)


@pytest.mark.parametrize(
    ("kind", "changes", "said"),
    [
        *((kind, {"sparsity_weight": value}, "sparsity_weight must") for kind in KINDS for value in (-0.1, nan)),
        *((kind, {"threshold": value}, r"lie in \[0, 1\)") for kind in KINDS[:2] for value in (-0.1, 1.0, nan)),
        *((TemporalMaskSettings, {name: 0}, "width >= 1") for name in ("features", "feature_times", "width")),
        *((TemporalMaskSettings, {name: -1}, "octaves >= 0") for name in ("frames", "octaves")),
        *((SampledMaskSettings, change, "a sampled mask needs") for change in ({"temperature": 0.0}, {"draws": 0})),
    ],
)
def test_settings_that_cannot_be(kind: type, changes: dict[str, float], said: str):
    with pytest.raises(ValueError, match=said):
        kind(**({"sparsity_weight": 1.0} | changes))
