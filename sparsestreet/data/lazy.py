"""Sequences whose items are read when they are asked for."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.frame_cache import MemoryForecast
from sparsestreet.types import Frame, Sweep, View


def spread(count: int, limit: int) -> list[int]:
    """At most ``limit`` of the places 0 .. count - 1, evenly; all of them if there are no more.

    From the first to the last: of c cameras in turn, an even step then never meets the same camera only, because the
    number of views less one shares no factor with c.
    """
    if limit >= count:
        return list(range(count))
    last, gaps = count - 1, limit - 1
    return [(2 * place * last + gaps) // (2 * gaps) for place in range(limit)] if gaps else [last // 2]


class LazySequence(Sequence):
    """For each key, what ``load`` makes of it: at each access anew. Slices load nothing.

    Not generic: a runtime check of a generic sequence would load an item.
    """

    def __init__(self, keys: Iterable[Any], load: Callable[[Any], Any]) -> None:
        self.keys = tuple(keys)
        self.load = load

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int | slice) -> Any:
        return self._of(self.keys[index]) if isinstance(index, slice) else self.load(self.keys[index])

    def __iter__(self) -> Iterator[Any]:
        # Not the default of a sequence, which takes an IndexError of ``load`` for the end.
        return map(self.load, self.keys)

    def where(self, keep: Callable[[Any], bool]) -> Any:
        """The items whose keys are wanted, in their order; none is loaded."""
        return self._of(filter(keep, self.keys))

    def at(self, places: Iterable[int]) -> Any:
        """The items at these places, in this order; none is loaded."""
        return self._of(self.keys[place] for place in places)

    def _of(self, keys: Iterable[Any]) -> Any:
        return type(self)(keys, self.load)


class Frames(LazySequence):
    """Recorded views. Their pixels are read when a frame is indexed; ``views`` tells the rest without.

    Threads may index at the same time.
    """

    def __init__(
        self, keys: Iterable[Any], load: Callable[[Any], Any], forecast: Callable[[], MemoryForecast] | None = None
    ) -> None:
        """``forecast``: how many frames of the whole log stay in memory once they were read; None: that has no
        meaning here."""
        super().__init__(keys, load)
        self.forecast = forecast

    @property
    def views(self) -> tuple[View, ...]:
        """Cameras, times and indices of all frames."""
        return self.keys

    def _of(self, keys: Iterable[Any]) -> "Frames":
        return type(self)(keys, self.load, self.forecast)


def as_frames(frames: Frames | Sequence[Frame]) -> Frames:
    """Return frames in memory as a lazy sequence; one that is lazy already as it is."""
    return frames if isinstance(frames, Frames) else Frames(frames, lambda frame: frame)


class Sweeps(LazySequence):
    """Lidar sweeps, keyed by their integer frames. They are read, and colored from images, when one is indexed."""

    def __init__(
        self,
        indices: Iterable[int],
        load: Callable[[int], Sweep],
        load_gray: Callable[[int], Sweep] | None = None,
        stamps: Mapping[int, int] | None = None,
        load_intensities: Callable[[int], Float[Tensor, " n"] | None] = lambda index: None,
    ) -> None:
        """``load_gray`` makes the same sweep without its colors, where that is cheaper; ``stamps`` of the sweeps, by
        their frames, are known without reading any. ``load_intensities`` reads those of a frame's returns, in [0, 1];
        None: the log has none."""
        super().__init__(indices, load)
        self.load_gray = load if load_gray is None else load_gray
        self.stamps = {} if stamps is None else stamps
        self.load_intensities = load_intensities

    @classmethod
    def of(cls, sweeps: "Sweeps | tuple[Sweep, ...]") -> "Sweeps":
        """Sweeps in memory as such a sequence; one that is one already as it is. Raises ValueError for twins."""
        if isinstance(sweeps, Sweeps):
            return sweeps
        by_index = {sweep.index: sweep for sweep in sweeps}
        if len(by_index) < len(sweeps):
            raise ValueError(
                f"a log has one sweep an instant, got {[sweep.index for sweep in sweeps]}: join those of one instant"
            )
        stamps = {index: sweep.stamp for index, sweep in by_index.items() if sweep.stamp is not None}
        return cls(by_index, by_index.__getitem__, stamps=stamps)

    @property
    def indices(self) -> tuple[int, ...]:
        """Integer frames of all sweeps."""
        return self.keys

    def gray(self) -> Iterator[Sweep]:
        """All sweeps: their points and which of them a camera sees. Colors mean nothing, and no image is decoded."""
        return map(self.load_gray, self.keys)

    def _of(self, keys: Iterable[int]) -> "Sweeps":
        return Sweeps(keys, self.load, self.load_gray, self.stamps, self.load_intensities)
