"""Room for the lists is guessed: any room that is large enough gives the same bits, and a small one a second try."""

import dataclasses
from unittest.mock import patch

import pytest
import torch

from sparsestreet.host_copy import HostCopy
from sparsestreet.ops import PairLimitError, SplatSettings, splat
from sparsestreet.ops.triton import lists, parts, pixels, screen
from sparsestreet.ops.triton.parts import Room
from sparsestreet.ops.triton.view import KernelView
from sparsestreet.types import Gaussians
from tests.ops.scenes import (
    camera,
    cast,
    device_of,
    fill_buffers_with_nan,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    render,
)
from tests.ops.triton.recording import record_launches
from tests.ops.triton.splitting import Rule, split_by

DEVICE = device_of("triton")
VIEW = camera(19, 17)
PLACE = lists.like(1000, KernelView(VIEW, SplatSettings()), DEVICE)


def scene() -> Gaussians:
    """With a row behind the camera, and one over all tiles."""
    behind, giant = one_gaussian(means=[[0.0, 0.0, -2.0]]), one_gaussian(scales=[[9.0] * 3], opacities=[0.4])
    return Gaussians.concatenate([behind, random_gaussians(3, VIEW, terms=1), giant])


def drawn(room: Room | None, waits: int) -> dict[str, torch.Tensor]:
    """Images and gradients with that guess, in short parts; ``waits``: how often lists wait for their exact size."""
    exactly, guess = patch.object(screen, "list_exactly", wraps=screen.list_exactly), lambda *_: room
    with exactly as called, patch.object(screen, "predicted", guess), split_by(Rule(min_part_pairs=2, min_parts=2)):
        result = render(scene(), VIEW, "triton", torch.float32)
    assert called.call_count == waits
    return result.images | result.gradients


@pytest.fixture(scope="module")
def exact() -> dict[str, torch.Tensor]:
    return drawn(None, waits=1)


@pytest.fixture(scope="module")
def taken() -> Room:
    """What the scene takes."""
    sizes = screen.project(cast(scene(), torch.float32, device=DEVICE), KernelView(VIEW, SplatSettings())).lists.sizes
    return Room(sizes.rows, sizes.pairs)


def assert_same_bits(found: dict[str, torch.Tensor], exact: dict[str, torch.Tensor]) -> None:
    for name, value in exact.items():
        assert torch.equal(found[name], value), name


@pytest.mark.lengthy
@pytest.mark.parametrize("more", first_interpreted([3, 9], [0, 0], [1, 0], [0, 1], [400, 2000]))
def test_any_room_that_is_large_enough_gives_the_same_bits(more, exact, taken, monkeypatch):
    fill_buffers_with_nan(monkeypatch)
    assert_same_bits(drawn(Room(taken.rows + more[0], taken.pairs + more[1]), waits=0), exact)


@pytest.mark.lengthy
@pytest.mark.parametrize("short", first_interpreted("pairs", "rows", "both"))
def test_a_view_that_does_not_fit_is_drawn_again(short, exact, taken, monkeypatch):
    fill_buffers_with_nan(monkeypatch)
    room = {"both": Room(1, 1), "rows": Room(taken.rows - 1, taken.pairs), "pairs": Room(taken.rows, taken.pairs - 1)}[
        short
    ]
    assert_same_bits(drawn(room, waits=1), exact)


@pytest.mark.parametrize(("rows", "pairs", "fits"), [(0, 0, True), (-1, 9, False), (9, -1, False)])
def test_what_does_not_fit_is_listed_as_nothing(rows, pairs, fits, taken, monkeypatch):
    fill_buffers_with_nan(monkeypatch)
    view = KernelView(VIEW, SplatSettings())
    projection = screen.project_all(cast(scene(), torch.float32, device=DEVICE), view)
    room = Room(taken.rows + rows, taken.pairs + pairs)
    visible = lists.list_rows(projection.records, projection.tile_counts, projection.sums, room, view)
    # All pairs, visible rows, bad rows; listed pairs, listed rows.
    listed = [taken.pairs, taken.rows] if fits else [0, 0]
    assert visible.sizes.on_device.tolist() == [taken.pairs, taken.rows, 0, *listed]
    # Where nothing is written there is no end to write beyond.
    assert (visible.rows == torch.iinfo(torch.int32).max).all().item() is not fits


def test_the_wait_comes_after_the_last_launch(monkeypatch):
    launches, seen = record_launches(monkeypatch), []
    waited = screen.wait_for

    def wait_for(arriving: HostCopy) -> list[int]:
        seen.append([launch.name for launch in launches])
        return waited(arriving)

    monkeypatch.setattr(screen, "wait_for", wait_for)
    gaussians = cast(scene(), torch.float32, device=DEVICE)
    for known in (False, True):
        launches.clear()
        splat(gaussians, VIEW, backend="triton")
        assert (seen[-1] == ["project_rows", "list_visible"]) is not known
        assert len(seen) == 1 + known
    names = [launch.name for launch in launches]
    assert names[-2:] == ["blend_tiles", "compose_pixels"]
    assert seen[-1] == names


def test_views_of_one_room_differ_in_addresses_alone(taken, monkeypatch):
    """What the host passes for the kernels after the projection, so that one graph could hold them."""
    passed: list[list] = [[]]

    def launch(kernel, items, block, *arguments, options=None, **constants):
        numbers = [value for value in arguments if not isinstance(value, torch.Tensor)]
        passed[-1].append((kernel.fn.__name__, items, block, numbers, options, constants))
        launches(kernel, items, block, *arguments, options=options, **constants)

    launches = screen.launch
    for module in (screen, lists, parts, pixels, pixels):
        monkeypatch.setattr(module, "launch", launch)
    monkeypatch.setattr(screen, "predicted", lambda *_: Room(taken.rows + 5, taken.pairs + 40))
    other = dataclasses.replace(VIEW, camera_from_world=VIEW.camera_from_world.clone())
    other.camera_from_world[0, 3] += 0.2
    images = []
    for view in (VIEW, other):
        images.append(splat(cast(scene(), torch.float32, device=DEVICE), view, backend="triton").rgb)
        passed.append([])
    assert not torch.equal(*images)
    assert len(passed[0]) == 7
    assert passed[0] == passed[1]


@pytest.mark.slow
def test_two_renderings_before_one_backward_pass():
    """Each has memory of its own: the gradients of the sum are the sum of the gradients."""
    other = dataclasses.replace(VIEW, camera_from_world=VIEW.camera_from_world.clone())
    other.camera_from_world[0, 3] += 0.2
    leaves, alone = [
        cast(random_gaussians(3, VIEW, terms=1), torch.float32, requires_grad=True, device=DEVICE) for _ in range(2)
    ]
    splat(leaves, VIEW, backend="triton")  # from now on rooms are guessed
    together = [splat(leaves, view, backend="triton") for view in (VIEW, other)]
    torch.stack([drawn.rgb.sum() + drawn.depth.sum() for drawn in together]).sum().backward()
    for view in (other, VIEW):
        rendering = splat(alone, view, backend="triton")
        (rendering.rgb.sum() + rendering.depth.sum()).backward()
    for name in ("means", "opacities", "sh"):
        # The order of the two is torch's.
        torch.testing.assert_close(getattr(leaves, name).grad, getattr(alone, name).grad, rtol=1e-6, atol=1e-6)


def test_what_is_refused_is_refused_after_a_guess_too(monkeypatch):
    gaussians = cast(scene(), torch.float32, device=DEVICE)
    splat(gaussians, VIEW, backend="triton")
    wrong = dataclasses.replace(gaussians, sh=gaussians.dense_sh().clone())
    wrong.dense_sh()[3, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="sh must be finite, but row 3 has nan"):
        splat(wrong, VIEW, backend="triton")
    monkeypatch.setattr(lists, "PAIR_LIMIT", 3)
    with pytest.raises(PairLimitError, match="more than the 3"):
        splat(gaussians, VIEW, backend="triton")


def test_pairs_beyond_32_bits_after_a_guess(monkeypatch):
    giant = one_gaussian(scales=[[1e7] * 3], opacities=[1.0])
    gaussians = cast(Gaussians.concatenate([giant] * 1050), torch.float32, device=DEVICE)
    monkeypatch.setattr(screen, "list_in", lambda *_: None)  # an image of gigabytes
    monkeypatch.setattr(screen, "predicted", lambda *_: Room(2000, 16))
    view = KernelView(front_camera(2**22, 128, 100.0), SplatSettings())
    with pytest.raises(PairLimitError, match=f"cover {1050 * 2**21} tiles"):
        screen.draw(gaussians, view, lambda _: None)


def test_room_for_a_quarter_more_than_the_largest_view():
    assert lists.predicted(PLACE, 1000, 10**9) is None
    lists.remember(PLACE, 600, 40_000)
    lists.remember(PLACE, 500, 80_000)
    # 750 and 100,000 in steps of an eighth of the power of two below.
    assert lists.predicted(PLACE, 1000, 10**9) == Room(768, 106_496)
    # No more rows than there are, and no more pairs than may be held.
    lists.remember(PLACE, 1000, 80_000)
    assert lists.predicted(PLACE, 1000, 90_000) == Room(1024, 90_000)


def test_a_large_view_is_forgotten():
    lists.remember(PLACE, 800, 80_000)
    for _ in range(28):
        lists.remember(PLACE, 80, 8_000)
    room = lists.predicted(PLACE, 1000, 10**9)
    assert room is not None
    assert room.holds(80_000, 800)
    for _ in range(600):
        lists.remember(PLACE, 80, 8_000)
    assert lists.predicted(PLACE, 1000, 10**9) == Room(112, 10_240)


@pytest.mark.parametrize(
    "other",
    [(2048, KernelView(VIEW, SplatSettings()), DEVICE), (1000, KernelView(camera(36, 33), SplatSettings()), DEVICE)],
    ids=["rows", "image"],
)
def test_other_views_tell_nothing(other):
    lists.remember(PLACE, 5, 9)
    assert lists.predicted(lists.like(*other), 1000, 10**9) is None
