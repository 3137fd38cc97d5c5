"""The mask over time: its formula, the frames it looks at, what it keeps, and what it leaves behind."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import BakedMask, MaskScope, TemporalMask, TemporalMaskSettings
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene, load_scene, save_scene
from tests.scene.street import RATES, background, degree, random_rows, view_at
from tests.typed import there

SETTINGS = TemporalMaskSettings(0.5, features=3, frames=2, width=5, octaves=2)
TIMES = (0.0, 0.25, 0.5, 1.0)
MASK_RATES = {**RATES, "mask": RATES["means"], "mask_features": RATES["means"]}


def scope(times: Sequence[Sequence[float]] = (TIMES,)) -> MaskScope:
    """Instances at a height of their own, 4 m long; times beyond a list's end are not valid."""
    longest = max(map(len, times))
    table = torch.tensor([[*each, *[9.0] * (longest - len(each))] for each in times])
    centers = torch.arange(len(times))[:, None] * torch.tensor([0.0, 0.0, 1.0])
    return MaskScope(table, table < 9.0, centers, torch.full((len(times), 3), 2.0))


def mask_of(min_gaussians: int = 0, where: MaskScope | None = None, seed: int = 0, **other: object) -> TemporalMask:
    """With random weights of the size of 1, so that scores differ between rows and times."""
    mask = replace(SETTINGS, **other).build(min_gaussians, scope() if where is None else where)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in mask.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
        mask.last.weight *= 4
    return mask


def node_of(mask: TemporalMask, count: int = 40):
    return background(random_rows(count, 1, mask=mask), mask, learning_rates=MASK_RATES)


def shown(node, time: float) -> Tensor:
    return node.gaussians_at(view_at(time), degree(1)).opacities > 0


def by_hand(mask: TemporalMask, features: np.ndarray, place: np.ndarray, time: float) -> float:
    """One row's score at one time in float64, layer by layer."""
    weights = {name: value.detach().double().numpy() for name, value in mask.named_parameters()}

    def encoded(values: np.ndarray) -> np.ndarray:
        waves = [wave(math.pi * 2**octave * values) for wave in (np.sin, np.cos) for octave in range(2)]
        return np.concatenate([values, *waves])

    row, moment = np.concatenate([features, encoded(place)]), encoded(np.array([time]))
    first = weights["of_row.weight"] @ row + weights["of_row.bias"] + weights["of_time.weight"] @ moment
    second = weights["hidden.weight"] @ np.maximum(first, 0) + weights["hidden.bias"]
    logit = weights["last.weight"] @ np.maximum(second, 0) + weights["last.bias"]
    return float(1 / (1 + np.exp(-logit[0])))


def test_scores_are_those_of_the_formula_with_one_sigmoid():
    mask = mask_of()
    rows = random_rows(6, 1, mask=mask)
    scores = mask.scores(rows, torch.tensor([[0.3, 0.8]]))
    for row in range(6):
        place = rows.means[row].detach().double().numpy() / 2
        for column, time in enumerate((0.3, 0.8)):
            expected = by_hand(mask, rows.mask_features[row].detach().double().numpy(), place, time)
            assert scores[row, column].item() == pytest.approx(expected, abs=2e-6)
    # One sigmoid of another one would stay above a half.
    assert float(scores.detach().min()) < 0.4


def test_features_of_several_times_are_those_of_the_moment():
    """Three times, 0, 0.5 and 1; at 0.3 three fifths of the second and two of the first, at 1 the last alone."""
    mask = mask_of(feature_times=3)
    rows = random_rows(6, 1, mask=mask)
    assert rows.mask_features.shape == (6, 9)
    assert torch.equal(rows.mask_features[:, :3], rows.mask_features[:, 6:])  # equal at first
    with torch.no_grad():
        rows.mask_features.copy_(torch.randn(6, 9, generator=torch.Generator().manual_seed(5)))
    times = torch.tensor([[0.3, 1.0, 0.8]])
    scores = mask.scores(rows, times)
    weights = ((0.4, 0.6, 0.0), (0.0, 0.0, 1.0), (0.0, 0.4, 0.6))
    for row in range(6):
        place = rows.means[row].detach().double().numpy() / 2
        stored = rows.mask_features[row].detach().double().numpy().reshape(3, 3)
        for column, (time, weight) in enumerate(zip((0.3, 1.0, 0.8), weights, strict=True)):
            expected = by_hand(mask, np.array(weight) @ stored, place, time)
            # float32 rounds 0.3 by 1e-8 and logits of size 10 by 1e-6.
            assert scores[row, column].item() == pytest.approx(expected, abs=4e-6)
    scores[:, 1].sum().backward()
    assert not rows.mask_features.grad[:, :6].any()


def test_a_new_mask_shows_everything_at_the_logit_it_is_given():
    mask = SETTINGS.build(0, scope())
    rows = random_rows(30, 1, mask=mask)
    scores = mask.scores(rows, torch.tensor([TIMES]))
    torch.testing.assert_close(scores, torch.full((30, 4), 1 / (1 + math.exp(-1.0))), atol=0.01, rtol=0)
    assert mask.keep(rows).removed == 0


def test_positions_count_from_the_instance_and_have_no_gradient():
    mask = mask_of(where=scope([TIMES, TIMES]))
    rows = random_rows(2, 1, mask=mask, instances=torch.tensor([0, 1]))
    with torch.no_grad():
        rows.mask_features[1] = rows.mask_features[0]
        rows.means[1] = rows.means[0] + torch.tensor([0.0, 0.0, 1.0])
    scores = mask.scores(rows, torch.tensor([TIMES]))
    torch.testing.assert_close(scores[0], scores[1])
    scores.sum().backward()
    assert rows.means.grad is None
    assert (rows.mask_features.grad != 0).any()


@pytest.mark.parametrize("image_closes", [True, False])
def test_the_multipliers_gradient_is_that_of_the_scores_and_may_be_kept_from_closing_masks(image_closes: bool):
    mask = mask_of(seed=2, image_closes=image_closes)
    rows = random_rows(20, 1, mask=mask)
    cotangent = torch.randn(20, generator=torch.Generator().manual_seed(3))
    (mask.multipliers(rows, 0.4) * cotangent).sum().backward()
    found = rows.mask_features.grad.clone()
    rows.mask_features.grad = None
    (
        mask.scores(rows, torch.tensor([[0.4]]))[:, 0] * cotangent.clamp(max=9.0 if image_closes else 0.0)
    ).sum().backward()
    assert torch.equal(found, there(rows.mask_features.grad))
    # So small a network has rows that no unit of it answers to: most of those pushed upwards move.
    moved = found.abs().sum(1) > 0
    assert moved[cotangent < 0].float().mean() > 0.5
    assert bool(moved[cotangent >= 0].any()) == image_closes
    assert 0 < mask.multipliers(rows, 0.4).sum() < 20


def test_the_loss_looks_at_now_and_at_frames_of_the_rows_own_instance():
    """Drawn frames are valid ones of each instance, and all of them come up."""
    mask = mask_of(where=scope([[0.0, 0.25, 0.5, 1.0], [0.75]]))
    seen = [mask._drawn_frames() for _ in range(50)]
    assert {round(float(time), 2) for frames in seen for time in frames[0]} == {0.0, 0.25, 0.5, 1.0}
    assert {float(time) for frames in seen for time in frames[1]} == {0.75}
    counts = torch.stack([frames[0] for frames in seen]).flatten().unique(return_counts=True)[1]
    assert counts.min() >= 22  # of 100, evenly spread over four
    rows = random_rows(2, 1, mask=mask, instances=torch.tensor([1, 1]))
    expected = mask.scores(rows, torch.tensor([[0.1, 0.75, 0.75]])).mean(1).sum()
    torch.testing.assert_close(mask.sparsity(rows, 0.1, torch.ones(2, dtype=torch.bool)), expected)


def test_a_resumed_mask_goes_on_with_other_frames():
    """What a checkpoint holds is how many steps have drawn: the next frames are those of the uninterrupted run."""
    mask, resumed = mask_of(), mask_of(seed=5)
    rows, drawn = random_rows(6, 1, mask=mask), torch.ones(6, dtype=torch.bool)
    before = [float(mask.sparsity(rows, 0.1, drawn).detach()) for _ in range(3)]
    resumed.load_state_dict(mask.state_dict())
    after = [float(mask.sparsity(rows, 0.1, drawn).detach()) for _ in range(3)]
    assert [float(resumed.sparsity(rows, 0.1, drawn).detach()) for _ in range(3)] == after != before


def test_rows_that_are_not_drawn_are_left_alone_where_the_settings_say_so():
    settings = TemporalMaskSettings(0.5, features=3, frames=2, width=5, octaves=2, visible_only=True)
    mask = settings.build(0, scope())
    rows = random_rows(4, 1, mask=mask)
    visible = torch.tensor([True, False, True, False])
    mask.sparsity(rows, 0.5, visible).backward()
    assert torch.equal(rows.mask_features.grad.abs().sum(1) > 0, visible)


def test_what_any_training_frame_shows_stays():
    mask = mask_of()
    node = node_of(mask)
    open_at = torch.stack([shown(node, time) for time in TIMES])
    selection = mask.keep(node.rows)
    assert torch.equal(selection.keep, open_at.any(0))
    assert 0 < selection.removed < 40
    assert (open_at.any(0) & ~open_at.all(0)).any()


def test_frames_without_the_instance_do_not_count():
    where = scope([TIMES, [0.25]])
    mask = mask_of(where=where, seed=1)
    rows = random_rows(40, 1, mask=mask, instances=torch.tensor([1]).expand(40))
    scores = mask.scores(rows, torch.tensor([[0.25]]))[:, 0]
    assert torch.equal(mask.keep(rows).keep, scores > 0.01)
    # Those that the padding of the table would have kept.
    padding = mask.scores(rows, torch.tensor([[9.0]]))[:, 0]
    assert ((padding > 0.01) & (scores <= 0.01)).any()


def test_at_the_floor_the_best_rows_stay_and_show():
    mask = mask_of(min_gaussians=38)
    node = node_of(mask)
    best = mask.scores(node.rows, torch.tensor([TIMES])).amax(1)
    selection = mask.keep(node.rows)
    assert int(selection.keep.sum()) == 38
    assert selection.floor_hit
    assert mask.floor_firings == 1
    assert best[selection.keep].min() >= best[~selection.keep].max()
    node.rows.resize(selection.plan())
    # At the floor nothing is hidden, at no time.
    assert torch.stack([shown(node, time) for time in TIMES]).all()
    with torch.no_grad():
        mask.last.bias.add_(20)
    assert not mask.keep(node.rows).floor_hit
    assert mask.limit.item() == pytest.approx(0.01)


@pytest.mark.parametrize("min_gaussians", [0, 38])
def test_baking_changes_nothing_at_training_times(min_gaussians):
    node = node_of(mask_of(min_gaussians))
    node.rows.resize(node.mask.keep(node.rows).plan())
    before = [node.gaussians_at(view_at(time), degree(1)) for time in TIMES]
    node.finish_mask()
    assert isinstance(node.mask, BakedMask)
    after = [node.gaussians_at(view_at(time), degree(1)) for time in TIMES]
    for left, right in zip(before, after, strict=True):
        assert torch.equal(left.opacities, right.opacities)
        assert torch.equal(left.scales, right.scales)
    assert not [name for name, _ in node.named_parameters() if "mask" in name]


def test_between_two_frames_a_row_shows_that_shows_at_either():
    node = node_of(mask_of())
    node.finish_mask()
    at = {time: shown(node, time) for time in TIMES}
    assert torch.equal(shown(node, 0.3), at[0.25] | at[0.5])
    assert torch.equal(shown(node, 0.25 + 1e-6), at[0.25])
    assert torch.equal(shown(node, 0.7), at[0.5] | at[1.0])
    # Beyond the frames the nearest one counts.
    assert torch.equal(shown(node, TIMES[0] - 0.2), at[TIMES[0]])
    assert torch.equal(shown(node, 1.2), at[1.0])
    assert (at[0.5] & ~at[1.0]).any()
    assert (at[0.5] & ~at[0.25]).any()


def test_before_the_first_of_eight_frames_the_last_one_does_not_show():
    """Their bits fill a byte: none of it is padding."""
    node = node_of(mask_of(where=scope([[0.2 + frame / 10 for frame in range(8)]])))
    node.finish_mask()
    node.rows.mask_bits.fill_(128)
    assert [int(shown(node, time).sum()) for time in (0.0, 0.2, 0.9, 1.0)] == [0, 0, 40, 40]


def test_bits_of_many_frames_and_of_none():
    """Eleven frames need two bytes a row; an empty table has none."""
    where = scope([[frame / 10 for frame in range(11)]])
    mask = mask_of(where=where)
    node = node_of(mask)
    scores = mask.scores(node.rows, where.times)
    node.finish_mask()
    assert node.rows.mask_bits.shape == (40, 2)
    bits = np.unpackbits(node.rows.mask_bits.numpy(), axis=1, bitorder="little")[:, :11]
    assert np.array_equal(bits.astype(bool), (scores > 0.01).numpy())
    for frame in range(11):
        assert torch.equal(shown(node, frame / 10), scores[:, frame] > 0.01)
    empty = node_of(mask_of(), count=0)
    assert empty.mask.keep(empty.rows).removed == 0
    empty.finish_mask()
    assert empty.rows.mask_bits.shape == (0, 1)


def test_bits_follow_the_rows_and_come_back_from_a_scene_file(tmp_path):
    node = node_of(mask_of())
    scene = SceneGraph({"people": node})
    keep = torch.arange(40) % 3 == 0
    expected = [shown(node, time)[keep] for time in TIMES]
    node.finish_mask()
    node.rows.resize(type(node.mask.keep(node.rows))(keep, False, 26).plan())
    path = tmp_path / "scene.safetensors"
    save_scene(path, StoredScene(scene, RenderOptions(), "drive", 5))
    restored = load_scene(path).scene.nodes["people"]
    assert all(map(torch.equal, [shown(restored, time) for time in TIMES], expected))
    assert restored.row_bytes() == node.row_bytes()


def test_a_scene_with_a_mask_in_training_is_written_as_it_leaves_it(tmp_path):
    node = node_of(mask_of())
    kept = node.mask.keep(node.rows).keep
    expected = [shown(node, time)[kept] for time in TIMES]
    path = tmp_path / "scene.safetensors"
    save_scene(path, StoredScene(SceneGraph({"people": node}), RenderOptions(), "drive", 5))
    restored = load_scene(path).scene.nodes["people"]
    assert all(map(torch.equal, [shown(restored, time) for time in TIMES], expected))
    assert isinstance(node.mask, TemporalMask)
    assert len(node.rows) == 40


def test_a_checkpoint_from_after_the_mask_stage_brings_the_bits():
    finished = node_of(mask_of())
    finished.rows.resize(finished.mask.keep(finished.rows).plan())
    finished.finish_mask()
    fresh = SceneGraph({"people": node_of(mask_of(seed=5), count=7)})
    fresh.load_state_dict(SceneGraph({"people": finished}).state_dict())
    node = fresh.nodes["people"]
    assert len(node.rows) == len(finished.rows) != 7
    assert all(torch.equal(shown(node, time), shown(finished, time)) for time in TIMES)
    assert fresh.learning_rates().keys() == SceneGraph({"people": finished}).learning_rates().keys()
