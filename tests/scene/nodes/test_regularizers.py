"""Terms that keep Gaussians and tracks in shape: by hand, by loops, by finite differences."""

import math

import pytest
import torch
from torch import Tensor

from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes.node import sharp_shape, temporal_smoothness
from sparsestreet.scene.state import SceneState
from tests.scene.street import background, random_rows, rigid, static_mask, view_at


def test_sharp_shape_by_hand():
    scales = torch.tensor([[1.0, 0.01, 0.1], [0.2, 0.2, 0.2], [0.5, 0.06, 0.4], [2.0, 0.1, 1.0]], dtype=torch.float64)
    # Ratios 100, 1, 8.3 and 20.
    expected = (math.log(100 / 10) + math.log(20 / 10)) / 4
    assert sharp_shape(scales.log(), 10.0).item() == pytest.approx(expected)


def test_gradient_of_sharp_shape_in_float64():
    log_scales = torch.randn(12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2
    log_scales[0] = 0.0  # a ball: all axes are longest and shortest
    assert torch.autograd.gradcheck(lambda values: sharp_shape(values, 3.0), log_scales.requires_grad_())


@pytest.mark.parametrize("log_scale", [-200.0, 200.0])
def test_needles_and_flat_gaussians_have_a_finite_term(log_scale):
    """exp of these is 0 or infinite in float32."""
    log_scales = torch.tensor([[0.0, 1.0, log_scale]], requires_grad=True)
    sharp_shape(log_scales, 10.0).backward()
    assert bool(log_scales.grad.isfinite().all())
    assert float(log_scales.grad.abs().sum()) == 2


def test_no_gaussians_no_term():
    assert sharp_shape(torch.zeros(0, 3), 10.0).item() == 0


def by_loops(times: Tensor, translations: Tensor, valid: Tensor) -> Tensor:
    """The neighbors stand still."""
    bends = []
    for track, at, known in zip(translations, times, valid, strict=True):
        for middle in range(len(track)):
            for distance in range(1, 6):
                before, after = middle - distance, middle + distance
                if before < 0 or after >= len(track) or not (known[before] and known[middle] and known[after]):
                    continue
                share = (at[middle] - at[before]) / (at[after] - at[before])
                line = ((1 - share) * track[before] + share * track[after]).detach()
                bends.append((2 * (track[middle] - line)).abs().mean())
    return torch.stack(bends).mean()


def tracks(count: int = 9, *, known: tuple[int, ...] = (9, 4, 1, 0)) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Unevenly spaced keyframes of four objects, of which the later have fewer."""
    generator = torch.Generator().manual_seed(0)
    times = torch.rand(len(known), count, generator=generator, dtype=torch.float64).cumsum(1)
    valid = torch.arange(count) < torch.tensor(known)[:, None]
    translations = torch.randn(len(known), count, 3, generator=generator, dtype=torch.float64)
    return torch.where(valid, times, 0.0), translations, valid


def test_smoothness_of_tracks_is_the_mean_over_all_neighbors():
    times, translations, valid = tracks()
    found, expected = (
        (bend, *torch.autograd.grad(bend, translations))
        for bend in (each(times, translations.requires_grad_(), valid) for each in (temporal_smoothness, by_loops))
    )
    torch.testing.assert_close(found, expected)


def test_evenly_spaced_it_is_the_second_difference():
    times = torch.tensor([[0.0, 0.5, 1.0]])
    translations = torch.tensor([[[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [1.0, 3.0, 1.0]]])
    # |0 + 1 - 2 * 2| and |0 + 3 - 0|, over three coordinates.
    assert temporal_smoothness(times, translations, torch.ones(1, 3, dtype=torch.bool)).item() == pytest.approx(6 / 3)


def test_constant_velocity_costs_nothing_where_frames_are_held_out():
    times = torch.tensor([[0.0, 0.1, 0.3, 0.4, 0.9]])
    translations = 5 * times[..., None] * torch.tensor([1.0, -2.0, 0.5]) + 7
    bend = temporal_smoothness(times, translations, torch.ones(1, 5, dtype=torch.bool))
    assert bend.item() == pytest.approx(0, abs=1e-5)  # of meters around 10 in float32


def test_only_the_keyframe_in_the_middle_moves():
    times, valid = torch.tensor([[0.0, 0.5, 1.0]]), torch.ones(1, 3, dtype=torch.bool)
    translations = torch.tensor([[[0.0] * 3, [2.0] * 3, [1.0] * 3]], requires_grad=True)
    temporal_smoothness(times, translations, valid).backward()
    assert translations.grad[0, :, 0].tolist() == pytest.approx([0.0, 2 / 3, 0.0])


@pytest.mark.parametrize("count", [0, 1, 2])
def test_tracks_too_short_for_three_keyframes(count):
    times, valid = torch.zeros(2, count), torch.ones(2, count, dtype=torch.bool)
    assert temporal_smoothness(times, torch.zeros(2, count, 3), valid).item() == 0


def curved() -> Trajectories:
    times = torch.tensor([[0.0, 0.5, 1.0]])
    translations = torch.tensor([[[0.0, 0.0, 0.0], [2.0, 1.0, 0.0], [3.0, 0.0, 0.0]]])
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(1, 3, 4).clone()
    return Trajectories(times, identity, translations, torch.ones(1, 3, dtype=torch.bool), torch.tensor([[0.0, 1.0]]))


def test_nodes_have_the_terms_that_their_settings_weigh():
    instances = torch.zeros(6, dtype=torch.long)
    road = background(random_rows(8, 0), sharp_shape=0.5, max_axis_ratio=2.0)
    cars = rigid(random_rows(6, 1, instances=instances), curved(), temporal_smooth=0.01, names=["car"])
    plain = rigid(random_rows(6, 1, instances=instances), curved(), names=["car"])
    scene, state = SceneGraph({"road": road, "cars": cars, "plain": plain}), SceneState()
    parts = {name: node.raw_at(view_at(0.5), state) for name, node in scene.nodes.items()}
    drawn = {name: torch.ones(len(part), dtype=torch.bool) for name, part in parts.items()}
    terms = scene.regularizers(view_at(0.0), parts, drawn, state)
    assert set(terms) == {"road/sharp_shape", "cars/temporal_smooth"}
    assert terms["road/sharp_shape"].item() == pytest.approx(0.5 * sharp_shape(road.rows.log_scales, 2.0).item())
    # |0 + 3 - 4| and |0 + 0 - 2| over three coordinates.
    assert terms["cars/temporal_smooth"].item() == pytest.approx(0.01 * 3 / 3)
    torch.stack(list(terms.values())).sum().backward()
    assert float(road.rows.log_scales.grad.abs().sum()) > 0
    # Learned corrections, not annotations, are pulled straight.
    assert cars.translation_deltas.grad[0, :, :2].tolist() == [
        [0, 0],
        pytest.approx([0.01 * 2 / 3, 0.01 * 2 / 3]),
        [0, 0],
    ]


def test_a_masked_gaussian_keeps_its_shape_in_the_term():
    mask = static_mask()
    rows = random_rows(4, 0, mask=mask)
    node = background(rows, mask, sharp_shape=1.0, max_axis_ratio=1.5)
    state, drawn = SceneState(), torch.ones(4, dtype=torch.bool)
    view = view_at(0.0)
    before = node.regularizers(view, node.raw_at(view, state), drawn, state)["sharp_shape"].item()
    with torch.no_grad():
        rows.mask_logits.fill_(-20.0)
    term = node.regularizers(view, node.raw_at(view, state), drawn, state)["sharp_shape"]
    term.backward()
    assert term.item() == before > 0
    assert bool(rows.log_scales.grad.isfinite().all())
