"""Nothing is read before it is asked for, and what was read stays while there is room."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sparsestreet.data.frame_cache import LruCache
from sparsestreet.data.lazy import Frames, LazySequence, Sweeps, as_frames
from sparsestreet.types import Frame, Sweep, View
from tests.data.plan import make_log

LOG = make_log(4, 2)


def loading(asked: list[View]) -> Frames:
    """The frames of LOG; whichever is loaded is noted down."""
    by_view = {id(frame): frame for frame in LOG.frames}

    def load(view: View) -> Frame:
        asked.append(view)
        return by_view[id(view)]

    return Frames(LOG.views, load)


def test_only_what_is_indexed_is_loaded():
    asked: list[View] = []
    frames = loading(asked)
    part = frames[2:7:2].where(lambda view: view.frame_index != 2)
    assert isinstance(part, Frames)
    assert [(view.frame_index, view.camera_index) for view in part.views] == [(1, 0), (3, 0)]
    assert len(frames) == 8
    assert asked == []
    assert part[-1] is LOG.frames[6]
    assert list(part) == [LOG.frames[2], LOG.frames[6]]
    assert asked == [LOG.frames[6], LOG.frames[2], LOG.frames[6]]
    with pytest.raises(IndexError):
        part[2]


def test_frames_in_memory_are_their_own_views():
    frames = tuple(LOG.frames)
    assert as_frames(frames).views == frames
    assert as_frames(frames)[3] is frames[3]
    assert as_frames(LOG.frames) is LOG.frames


def test_sweeps_are_found_by_their_place_and_told_by_their_index():
    sweeps = tuple(Sweep(index, 0.0, torch.zeros(1, 3), torch.zeros(1, 3), torch.ones(1).bool()) for index in (0, 2, 5))
    held = Sweeps.of(sweeps)
    assert (held.indices, held[1], tuple(held.gray())) == ((0, 2, 5), sweeps[1], sweeps)
    with pytest.raises(ValueError, match="one sweep an instant"):
        Sweeps.of((sweeps[0], sweeps[0]))


def test_a_part_of_the_sweeps_stays_as_cheap_as_the_whole():
    def load(index: int) -> Sweep:
        raise AssertionError(f"sweep {index} was colored")

    gray = Sweep(7, 0.0, torch.zeros(1, 3), torch.zeros(1, 3), torch.ones(1).bool())
    part = Sweeps((3, 7), load, lambda index: gray).where(lambda index: index > 3)
    assert part.indices == (7,)
    assert list(part.gray()) == list(part[:1].gray()) == [gray]


def test_stamps_of_sweeps_are_known_without_reading_any():
    def load(index: int) -> Sweep:
        raise AssertionError(f"sweep {index} is read")

    assert Sweeps([3, 5], load, stamps={3: 300, 5: 500}).where(lambda index: index > 3).stamps[5] == 500
    sweep = Sweep(2, 0.0, torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1, dtype=torch.bool), 0.0, 200)
    assert Sweeps.of((sweep,)).stamps == {2: 200}


def test_what_was_not_used_for_longest_makes_way():
    asked: list[int] = []

    def load(key: int) -> int:
        asked.append(key)
        return key

    cache = LruCache(load, size=lambda value: value, room=10)
    assert [cache(key) for key in (3, 4, 2, 3)] == [3, 4, 2, 3]  # 9 of 10 are used
    assert asked == [3, 4, 2]
    cache(5)  # 14: 4 must go, for 3 was used after it, and 2 is enough to stay
    cache(3)
    cache(2)
    assert asked == [3, 4, 2, 5]
    cache(4)  # now 5 was not used for longest
    cache(3)
    cache(2)
    assert asked == [3, 4, 2, 5, 4]
    cache(5)
    assert asked == [3, 4, 2, 5, 4, 5]


def test_what_is_larger_than_the_room_is_not_kept_and_drives_nothing_out():
    asked: list[int] = []

    def load(key: int) -> int:
        asked.append(key)
        return key

    cache = LruCache(load, size=lambda value: value, room=10)
    for key in (10, 11, 10, 11):
        assert cache(key) == key
    assert asked == [10, 11, 11]


@settings(deadline=None)  # the first example pays for what is built once
@given(st.lists(st.integers(0, 12), max_size=60), st.integers(0, 30))
def test_a_cache_never_holds_more_than_it_may_and_forgets_only_where_it_must(keys, room):
    """Against a list in order of use, the straightforward way."""
    asked: list[int] = []

    def load(key: int) -> int:
        asked.append(key)
        return key

    cache = LruCache(load, size=lambda value: value, room=room)
    held, expected = [], []
    for key in keys:
        cache(key)
        if key not in held:
            expected.append(key)
        if key > room:
            continue
        held = [other for other in held if other != key] + [key]
        while sum(held) > room:
            held.pop(0)
    assert asked == expected


def test_an_error_of_reading_does_not_end_an_iteration():
    def load(key: int) -> int:
        return [5, 6][key]

    with pytest.raises(IndexError):
        list(LazySequence(range(3), load))
