"""Nothing is read before it is asked for."""

import pytest
import torch

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


def test_an_error_of_reading_does_not_end_an_iteration():
    def load(key: int) -> int:
        return [5, 6][key]

    with pytest.raises(IndexError):
        list(LazySequence(range(3), load))
