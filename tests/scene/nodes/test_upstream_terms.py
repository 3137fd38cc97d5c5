"""The forms that DriveStudio gives to terms of which ours is another: by hand, by loops, on average."""

import pytest
import torch

from sparsestreet.scene.nodes.node import excess_volume, sharp_shape_ratio, temporal_smoothness, temporal_smoothness_at
from sparsestreet.scene.state import SceneState
from tests.scene.nodes.test_regularizers import curved, tracks
from tests.scene.people import smpl, walker
from tests.scene.street import background, random_rows, rigid, view_at


def test_needles_count_by_their_ratio():
    scales = torch.tensor([[1.0, 0.01, 0.1], [0.2, 0.2, 0.2], [0.5, 0.06, 0.4], [2.0, 0.1, 1.0]], dtype=torch.float64)
    # Ratios 100, 1, 8.3 and 20, of which 10 are free.
    assert sharp_shape_ratio(scales.log(), 10.0).item() == pytest.approx((90 + 10) / 4)
    log_scales = torch.randn(12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda values: sharp_shape_ratio(values, 3.0), log_scales.requires_grad_())
    assert sharp_shape_ratio(torch.zeros(0, 3), 10.0).item() == 0


def test_the_term_against_needles_comes_at_every_tenth_step():
    node = background(
        random_rows(8, 0), sharp_shape=0.5, max_axis_ratio=2.0, sharp_shape_form="ratio", sharp_shape_every=10
    )
    drawn, view = torch.ones(8, dtype=torch.bool), view_at(0.0)
    raw = node.raw_at(view, SceneState())
    terms = [node.regularizers(view, raw, drawn, SceneState(step=step)) for step in range(21)]
    assert [step for step, found in enumerate(terms) if found] == [0, 10, 20]
    expected = 0.5 * sharp_shape_ratio(node.rows.log_scales, 2.0)
    assert terms[0]["sharp_shape"].item() == pytest.approx(expected.item())


def test_volumes_beyond_their_quantile():
    volumes = torch.tensor([5.0, 1.0, 4.0, 2.0, 3.0], dtype=torch.float64)
    log_scales = volumes.log()[:, None] * torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
    # floor(0.8 * 5) = 4, so the fourth is the limit: only 5 is beyond 4.
    assert excess_volume(log_scales, 0.8).item() == pytest.approx(1 / 5)
    assert excess_volume(log_scales, 0.4).item() == pytest.approx((1 + 2 + 3) / 5)
    assert excess_volume(log_scales[:1], 0.5).item() == 0  # no row is the limit


def test_people_have_that_term_from_its_fraction_of_the_run_on():
    node = smpl(walker(), volume_weight=2.0, volume_from=0.2)
    drawn, raw = torch.ones(len(node.rows), dtype=torch.bool), node.raw_at(view_at(0.5), SceneState())
    late, early = (node.own_regularizers(raw, drawn, SceneState(progress)) for progress in (0.2, 0.19))
    assert late["volume"].item() == pytest.approx(2 * excess_volume(node.rows.log_scales, 0.99).item())
    assert "volume" not in early
    assert "volume" not in smpl(walker()).own_regularizers(raw, drawn, SceneState(0.2))
    with pytest.raises(ValueError, match="volume_weight is a weight"):
        smpl(walker(), volume_quantile=0.0)


def test_frames_and_distances_one_by_one_have_the_mean_of_all():
    """Weighted by how many objects have the three keyframes, which the term of a step is a mean over."""
    times, translations, valid = tracks()
    times = times / 20  # below 1
    total, count = 0.0, 0
    for distance in range(1, 6):
        for keyframe in times[0].tolist():
            alone = temporal_smoothness_at(times[:1], translations[:1], valid[:1], keyframe, distance)
            known = times[0].tolist().index(keyframe) in range(distance, 9 - distance)
            assert known or alone == 0
            total, count = total + alone.item(), count + known
    assert total / count == pytest.approx(temporal_smoothness(times[:1], translations[:1], valid[:1]).item())


def test_the_term_of_a_frame_is_a_mean_over_the_objects_that_have_it():
    times = torch.tensor([[0.0, 0.1, 0.2], [0.1, 0.2, 0.3], [0.0, 0.1, 0.0]])
    translations = torch.zeros(3, 3, 3)
    translations[0, 1], translations[1, 1] = 1.0, 5.0
    valid = torch.tensor([[True] * 3, [True] * 3, [True, True, False]])
    at = [temporal_smoothness_at(times, translations, valid, time, 1).item() for time in (0.0, 0.1, 0.2, 0.24, 0.36)]
    # |0 + 0 - 2 x 1|, then |0 + 0 - 2 x 5|; the third object has no keyframe after its second. A camera that fires
    # 0.04 after the boxes sees these; one 0.06 after the last of an object sees none.
    assert at == pytest.approx([0, 2, 10, 10, 0])
    # Where a keyframe is missing nobody is near, though the one before is the nearest.
    gap, whole = torch.tensor([[0.0, 0.1, 0.3]]), torch.ones(1, 3, dtype=torch.bool)
    near = [temporal_smoothness_at(gap, translations[:1], whole, time, 1).item() for time in (0.145, 0.16)]
    assert near == pytest.approx([2, 0])
    translations.requires_grad_()
    temporal_smoothness_at(times, translations, valid, 0.1, 1).backward()
    assert translations.grad[0, :, 0].tolist() == pytest.approx([0, 2 / 3, 0])  # the neighbors stand still
    assert not translations.grad[1:].any()


def test_a_node_draws_the_distance_by_the_step():
    node = rigid(
        random_rows(6, 1, instances=torch.zeros(6, dtype=torch.long)),
        curved(),
        temporal_smooth=0.01,
        temporal_smooth_of="frame",
        names=["car"],
    )
    drawn, view = torch.ones(6, dtype=torch.bool), view_at(0.5)
    raw = node.raw_at(view, SceneState())

    def term(step: int) -> float:
        return node.regularizers(view, raw, drawn, SceneState(step=step))["temporal_smooth"].item()

    found = [term(step) for step in range(60)]
    # Three keyframes: only the distance 1 of 1 ... 5 is there. |0 + 3 - 4| and |0 + 0 - 2| over three coordinates.
    assert {round(value, 6) for value in found} == {0.0, 0.01}
    assert 4 <= sum(value > 0 for value in found) <= 22  # 12 of 60; standard deviation 3.1
    assert found == [term(step) for step in range(60)]
