"""Renderings as CUDA graphs say the same as others, whatever has changed since they were captured."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sparsestreet.geometry.cameras import moved
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.triton import graphs, lists
from sparsestreet.ops.triton.parts import Room
from sparsestreet.types import Camera, Gaussians, Harmonics, Shutter
from tests.ops.scenes import CPU, camera, cast, cotangents, device_of, front_camera, one_gaussian, random_gaussians
from tests.ops.triton.replaying import HostCalls, record_graphs

DEVICE = device_of("triton")
VIEW, SMALL = camera(19, 17), camera(9, 7)
pytestmark = pytest.mark.skipif(DEVICE != CPU, reason="graphs are recorded where there is no device")


@pytest.fixture(autouse=True)
def recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    record_graphs(monkeypatch)
    monkeypatch.setattr(lists, "_seen", {})


def scene(seed: int) -> Gaussians:
    """The first row covers all tiles, the last is behind the camera."""
    behind, giant = one_gaussian(means=[[0.0, 0.0, -2.0]]), one_gaussian(scales=[[9.0] * 3], opacities=[0.4])
    rows = Gaussians.concatenate([giant, random_gaussians(4, VIEW, terms=4, seed=seed), behind])
    return cast(rows, torch.float32)


class Tables:
    """Harmonics of two parts in tables that stay where they are; of the second only the first coefficients."""

    def __init__(self) -> None:
        self.firsts, self.rests = (
            (torch.zeros(2, 1, 3), torch.zeros(4, 1, 3)),
            (torch.zeros(2, 3, 3), torch.zeros(4, 0, 3)),
        )
        self.learned = [table.requires_grad_() for table in (*self.firsts, *self.rests)]

    def of(self, seed: int) -> Gaussians:
        """Other rows, whose harmonics are written into the tables."""
        rows = scene(seed)
        with torch.no_grad():
            for first, rest, own in zip(self.firsts, self.rests, rows.dense_sh().split((2, 4)), strict=True):
                first.copy_(own[:, :1])
                rest.copy_(own[:, 1 : 1 + rest.shape[1]])
        return replace(rows, sh=Harmonics(self.firsts, self.rests, 4))


def kind(name: str, seed: int) -> tuple[Camera, dict[str, Any], Tensor | None]:
    """Camera, arguments and displacements of a view; numbers differ by seed, launches do not."""
    generator = torch.Generator().manual_seed(seed)
    seen = moved(VIEW, 0.1 * torch.randn(3, generator=generator, dtype=torch.float64))
    if name == "lens":
        bent = torch.tensor([0.1, -0.02, 0.001, 0.002, 0.0], dtype=torch.float64) * (1 + 0.1 * seed)
        return replace(seen, distortion=bent), {"settings": SplatSettings(antialias=True)}, None
    shutter = Shutter(0.1 * torch.rand(3, generator=generator), 0.02 * torch.rand(3, generator=generator), "bottom")
    behind = torch.rand(17, 19, 3, generator=generator)
    return replace(seen, shutter=shutter), {"background": behind}, 0.1 * torch.randn(6, 3, generator=generator)


def leaves(gaussians: Gaussians) -> tuple[list[Tensor], Gaussians]:
    """Copies of what is activated, and the Gaussians of them."""
    means, quaternions, scales, opacities = (one.detach().clone().requires_grad_() for one in gaussians.learned()[:4])
    columns = [means, quaternions, scales, opacities]
    return columns, replace(gaussians, means=means, quaternions=quaternions, scales=scales, opacities=opacities)


def drawn(
    gaussians: Gaussians, tables: Tables, view: Camera, *, replay: bool, given: tuple[Tensor, ...], **arguments: Any
) -> list[Tensor]:
    """Images and gradients."""
    columns, rows = leaves(gaussians)
    found = splat(rows, view, backend="triton", replay=replay, **arguments)
    outputs = (found.rgb, found.alpha, found.depth)
    learned = [*columns, *(table for table in tables.learned if table.numel()), found.screen_offsets]
    gradients = torch.autograd.grad(outputs, learned, [one.float() for one in given])
    return [*(output.detach() for output in outputs), found.radii, *gradients]


def counts() -> tuple[int, int, int]:
    return graphs.COUNTS["captured"], graphs.COUNTS["replayed"], graphs.COUNTS["again"]


def assert_same(found: list[Tensor], expected: list[Tensor]) -> None:
    for place, (one, other) in enumerate(zip(found, expected, strict=True)):
        assert torch.equal(one, other), place


@pytest.mark.lengthy
@pytest.mark.parametrize("name", ["shutter", pytest.param("lens", marks=pytest.mark.slow)])
def test_a_replay_has_the_bits_of_other_numbers(name: str):
    """Rows, harmonics, camera, background and cotangents are others each time. The first rendering finds the room, the
    second is captured, the third's backward pass."""
    tables, kept = Tables(), []
    for seed in range(4):
        view, arguments, displacements = kind(name, seed)
        rows = replace(tables.of(seed), displacements=displacements)
        given = cotangents(view, seed)
        expected = drawn(rows, tables, view, replay=False, given=given, **arguments)
        found = drawn(rows, tables, view, replay=True, given=given, **arguments)
        assert_same(found, expected)
        kept.append((found, expected))
    assert counts() == (3, 3, 0)
    for found, expected in kept:  # nobody writes over what was returned
        assert_same(found, expected)


def test_a_view_whose_backward_pass_may_come_is_not_drawn_over():
    tables = Tables()
    rows, given = tables.of(0), cotangents(SMALL)
    expected = drawn(rows, tables, SMALL, replay=False, given=given)
    drawn(rows, tables, SMALL, replay=True, given=given)

    def render() -> tuple[Tensor, Tensor]:
        means = rows.means.clone().requires_grad_()
        return splat(replace(rows, means=means), SMALL, backend="triton", replay=True).rgb, means

    first, moved_rows = render()
    other, _ = render()
    assert graphs.COUNTS["replayed"] == 1
    assert all(torch.equal(one, expected[0]) for one in (first, other))
    gradient = torch.autograd.grad(first, moved_rows, torch.ones_like(first))[0]
    del first, other
    means = rows.means.clone().requires_grad_()
    whole = splat(replace(rows, means=means), SMALL, backend="triton").rgb
    assert torch.equal(gradient, torch.autograd.grad(whole, means, torch.ones_like(whole))[0])
    lists._seen.clear()
    render()
    assert graphs.COUNTS["replayed"] == 2
    assert lists._seen  # what a graph took is known to the next room


@pytest.mark.lengthy
def test_backward_passes_of_several_kinds_are_told_apart():
    """Of the color alone to the means, of the depth to all, in turn."""
    tables = Tables()
    rows, (v_rgb, _, v_depth) = tables.of(0), (one.float() for one in cotangents(SMALL))
    answers: dict[bool, list[list[Tensor]]] = {False: [], True: []}
    for _ in range(4):
        for replay, found in answers.items():
            columns, own = leaves(rows)
            seen = splat(own, SMALL, backend="triton", replay=replay)
            if len(found) % 2:
                found.append(list(torch.autograd.grad(seen.rgb, columns[:1], v_rgb)))
            else:
                found.append(list(torch.autograd.grad(seen.depth, columns, v_depth)))
    for one, other in zip(*answers.values(), strict=True):
        assert_same(one, other)
    assert counts() == (3, 3, 0)


def test_a_view_that_does_not_fit_is_drawn_again_and_the_next_has_more_room(monkeypatch: pytest.MonkeyPatch):
    tables, given = Tables(), cotangents(SMALL)
    rows = tables.of(0)
    expected = drawn(rows, tables, SMALL, replay=False, given=given)
    drawn(rows, tables, SMALL, replay=True, given=given)
    with monkeypatch.context() as patch:
        patch.setattr(graphs, "predicted", lambda *_: Room(6, 3))
        assert_same(drawn(rows, tables, SMALL, replay=True, given=given), expected)
    assert counts() == (2, 0, 1)
    assert_same(drawn(rows, tables, SMALL, replay=True, given=given), expected)
    assert counts() == (4, 1, 1)


def test_frames_without_gradients_are_replayed_and_stay():
    """Also an empty view, and cameras of two sizes in turn."""
    tables, other = Tables(), front_camera(9, 3, 4.0)
    away = moved(SMALL, torch.tensor([0.0, 0.0, 500.0], dtype=torch.float64))
    rows, images = tables.of(1), []
    with torch.no_grad():
        for view in (SMALL, other, SMALL, other, away):
            found = splat(rows, view, backend="triton", replay=True)
            images.append((found.rgb, splat(rows, view, backend="triton").rgb))
    assert graphs.COUNTS["replayed"] == 3
    assert all(torch.equal(one, other) for one, other in images)
    assert not images[4][0].any()


def test_graphs_of_tables_that_are_gone_are_forgotten_and_few_are_kept(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(graphs, "MAX_KEPT", 2)
    with torch.no_grad():
        for width in (4, 5, 6):
            splat(scene(0), front_camera(width, 3, 4.0), backend="triton", replay=True)
        assert [kind[4] for kind in graphs._kept] == [5, 6]
        tables = Tables()
        for _ in range(2):
            splat(tables.of(0), SMALL, backend="triton", replay=True)
        (graph,) = (one for one in graphs._kept.values() if one is not None)
        assert not graph.is_stale
        graph._storages[0] = type(graph._storages[0])(torch.empty(3).untyped_storage())
        assert graph.is_stale
        splat(scene(1), front_camera(3, 2, 4.0), backend="triton", replay=True)
    assert all(one is not graph for one in graphs._kept.values())


def test_what_is_wrong_is_said_as_ever():
    tables = Tables()
    rows = tables.of(0)
    with torch.no_grad():
        for _ in range(2):
            splat(rows, SMALL, backend="triton", replay=True)
        rows.means[3, 1] = torch.nan
        with pytest.raises(ValueError, match=r"means.*row 3"):
            splat(rows, SMALL, backend="triton", replay=True)


def test_the_host_says_little():
    """Of a street of two parts. A device adds the copy of the sizes, and the event behind it, to both numbers."""
    tables, calls = Tables(), {}
    rows, v_rgb = tables.of(0), cotangents(SMALL)[0].float()
    for replay in (True, True, True, True, False):
        columns, own = leaves(rows)
        with HostCalls() as forward:
            seen = splat(own, SMALL, backend="triton", replay=replay)
        with HostCalls() as backward:
            torch.autograd.grad(seen.rgb, columns, v_rgb)
        calls[replay] = forward.count, backward.count
        del seen  # or its graph would be kept for another backward pass
    assert calls == {True: (4, 3), False: (14, 5)}
