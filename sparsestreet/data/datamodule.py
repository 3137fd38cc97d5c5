"""Frames in the order that training and validation want them."""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Int
from lightning import LightningDataModule
from torch import Tensor

from sparsestreet.data.frame_cache import Prefetcher, prefetched, to_device
from sparsestreet.data.hood import Hood, find_dirt, find_hoods, with_ego
from sparsestreet.data.lazy import Frames, spread
from sparsestreet.data.lidar import recolored
from sparsestreet.data.log import DrivingLog, split
from sparsestreet.phases import phase
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.types import Frame

logger = logging.getLogger(__name__)

HOST = torch.device("cpu")


class Draws:
    """Which of ``count`` frames each draw of a training takes: a new random order each epoch, shared by processes."""

    def __init__(self, count: int, seed: int, *, with_replacement: bool = False, ranks: Ranks = ALONE) -> None:
        self.count, self.seed, self.with_replacement, self.ranks = count, seed, with_replacement, ranks
        self._orders: dict[int, list[int]] = {}

    def place(self, draw: int) -> int:
        """Return which frame a draw of this process takes, of all its draws since the start of training."""
        epoch, position = divmod(draw * self.ranks.size + self.ranks.rank, self.count)
        order = self._orders.get(epoch)
        if order is None:
            order = self.order(epoch)
            # Draws ahead are of this epoch and the next ones; earlier ones do not come again.
            self._orders = {other: kept for other, kept in self._orders.items() if other == epoch - 1} | {epoch: order}
        return order[position]

    def order(self, epoch: int) -> list[int]:
        """Return the frames of an epoch in the order in which all processes draw them."""
        # One stream of the seed, of which epoch e takes the e-th permutation: seeds 0 and 1 share no epoch.
        generator = torch.Generator().manual_seed(self.seed)
        for _ in range(epoch):
            self._draw(generator)
        return self._draw(generator).tolist()

    def last(self, end: int) -> frozenset[int]:
        """Return what ``ShuffledFrames.last_draws`` does."""
        count, size, stop = self.count, self.ranks.size, end * self.ranks.size
        # Without replacement every frame is drawn in the last two epochs.
        first = 0 if self.with_replacement else max(stop // count - 1, 0)
        drawn = [place for epoch in range(first, -(-stop // count)) for place in self.order(epoch)]
        last = {place: number for number, place in enumerate(drawn[: stop - first * count], first * count)}
        return frozenset(number // size for number in last.values() if number % size == self.ranks.rank)

    def _draw(self, generator: torch.Generator) -> Int[Tensor, " n"]:
        if self.with_replacement:
            return torch.randint(self.count, (self.count,), generator=generator)
        return torch.randperm(self.count, generator=generator)


class ShuffledFrames:
    """All frames in a new random order each epoch, given by seed and epoch alone; endless if asked again and again.

    Threads read the next frames while a step computes (``Prefetcher``), for the order is known. An iterator that is
    dropped half way is taken up again by the next one. The place is part of checkpoints (Lightning asks for
    ``state_dict``): a resumed training sees the frames that an uninterrupted one would have seen.
    """

    def __init__(
        self,
        frames: Frames,
        seed: int,
        finished: Callable[[], int] | None = None,
        *,
        with_replacement: bool = False,
        ranks: Ranks = ALONE,
        accumulated: int = 1,
        device: torch.device = HOST,
        threads: int | None = None,
    ) -> None:
        """
        Args:
            frames: of an epoch.
            seed: of the order.
            finished: with how many frames training has finished since its start. A frame that was drawn for a step
                which was interrupted is to be drawn again, and only training knows. None: with all that were drawn.
            with_replacement: every frame is drawn from all of them, so that an epoch has some twice and some never.
            ranks: the processes that take turns in one order; each iterator gives this one's frames.
            accumulated: frames of a process whose gradients a step takes. What an iterator gives are whole steps, as
                many as there are frames, so that no step ends with an epoch.
            device: where frames are wanted.
            threads: as in ``Prefetcher``.
        """
        self.frames = frames
        self._accumulated = accumulated
        self._drawn = 0
        self._finished = finished
        self._draws = draws = Draws(len(frames), seed, with_replacement=with_replacement, ranks=ranks)
        # Of ``self`` it knows nothing, so that its threads end where ``self`` is dropped.
        self._ahead = Prefetcher(lambda draw: frames[draws.place(draw)], device, threads)

    def __len__(self) -> int:
        return len(self.frames) * self._accumulated

    def __iter__(self) -> Iterator[Frame]:
        for drawn in range(self._drawn, (self._drawn // len(self) + 1) * len(self)):
            self._drawn += 1
            with phase("data"):
                frame = self._ahead.take(drawn)
            yield frame

    def close(self) -> None:
        """Ends the threads that read; another iteration starts new ones."""
        self._ahead.close()

    def last_draws(self, end: int) -> frozenset[int]:
        """Return this process's draws before ``end`` whose frames no process draws once more before that.

        Every frame is among those of all processes once, unless it was never drawn."""
        return self._draws.last(end)

    def state_dict(self) -> dict[str, int]:
        return {"finished": self._drawn if self._finished is None else self._finished()}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self._drawn = state["finished"]


class OrderedFrames:
    """Frames as they come, from the start each time, read ahead. (Lightning takes a bare sequence for several loaders.)

    Threads read while an iteration lasts."""

    def __init__(
        self, frames: Frames, limit: int | None = None, device: torch.device = HOST, ranks: Ranks = ALONE
    ) -> None:
        """
        Args:
            frames: all of them.
            limit: so many of the frames, spread evenly over all of them, the first and the last included.
            device: where frames are wanted.
            ranks: the processes that share the frames, as ``ranks.share`` does. Where there are fewer frames than
                processes, each one has all: an iteration of none would be left out.
        """
        places = list(range(len(frames)) if limit is None else spread(len(frames), limit))
        self.frames = frames.at(ranks.share(places) if ranks.size <= len(places) else places)
        self._device = device

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return prefetched(self.frames, self._device)


class StreetData(LightningDataModule):
    """A log, split into frames to train on and frames to hold out; each batch is one Frame, each step takes one.

    The loaders are plain iterables: frames are decoded by threads and kept in memory, which processes would not share.
    """

    def __init__(
        self,
        log: DrivingLog,
        *,
        stride: int = 10,
        offset: int = 5,
        cameras: Sequence[str | int] = (),
        seed: int = 0,
        val_frames: int | None = None,
        with_replacement: bool = False,
        hood: float | None = None,
        dirt: float | None = None,
    ) -> None:
        """
        Args:
            log: what to train on.
            stride: as in ``split``.
            offset: as in ``split``.
            cameras: as in ``split``.
            seed: of the order of the training frames.
            val_frames: images that each validation looks at, spread over the held-out ones; None: all.
            with_replacement: as in ``ShuffledFrames``.
            hood: what is found of the recording car joins the ``ego`` pixels of all frames of a camera that shows at
                least this share of it; None: it is not looked for.
            dirt: the same of spots on the lens.
        """
        super().__init__()
        if val_frames is not None and val_frames < 1:
            raise ValueError(f"val_frames must be at least 1, got {val_frames}: say null for all held-out images")
        log = replace(log, kept=log.kept.within(stride, offset, cameras, hood, dirt))
        log = log.holding_out(split(log, stride=stride, offset=offset, cameras=cameras).held_out_indices)
        log = _masked(log, split(log, stride=stride, offset=offset, cameras=cameras).train, hood, dirt)
        self.split = split(log, stride=stride, offset=offset, cameras=cameras)
        # Colors of a sweep are those of images, so a camera that is held out gives none.
        self.driving_log = replace(log, sweeps=recolored(log, self.split)) if cameras else log
        instants = [f"every {stride}th frame from {offset}"] if stride else []
        held_out = instants + [f"camera {name}" for name in cameras]
        self.split_in_words = " and ".join(held_out) or "none"
        """Which frames are held out, for records."""
        self.seed = seed
        self.val_frames = val_frames
        self.with_replacement = with_replacement
        self._training: ShuffledFrames | None = None

    def train_dataloader(self) -> ShuffledFrames:
        """One training frame a step; an epoch is all of them in random order."""
        trainer = self.trainer
        if self.split.train.forecast is not None:
            logger.info("%s", self.split.train.forecast())
        self._close()
        accumulated = 1 if trainer is None else trainer.accumulate_grad_batches
        self._training = ShuffledFrames(
            self.split.train,
            self.seed,
            None if trainer is None else lambda: trainer.global_step * accumulated,
            with_replacement=self.with_replacement,
            ranks=ALONE if trainer is None else getattr(trainer.strategy, "ranks", ALONE),
            accumulated=accumulated,
            device=self._device,
        )
        return self._training

    def last_draws(self, end: int) -> frozenset[int]:
        """Return those of the loader; none before there is one."""
        return frozenset() if self._training is None else self._training.last_draws(end)

    def val_dataloader(self) -> OrderedFrames | list:
        """The held-out frames in the order of the log, or ``val_frames`` of them; no loader where none is held out. Of
        several processes each has its share."""
        held_out = self.split.held_out
        if not len(held_out):
            return []
        ranks = ALONE if self.trainer is None else getattr(self.trainer.strategy, "ranks", ALONE)
        return OrderedFrames(held_out, self.val_frames, self._device, ranks)

    def teardown(self, stage: str) -> None:
        self._close()

    def on_exception(self, exception: BaseException) -> None:
        self._close()

    def _close(self) -> None:
        if self._training is not None:
            self._training.close()

    @property
    def _device(self) -> torch.device:
        """Where steps want their frames."""
        return HOST if self.trainer is None else self.trainer.strategy.root_device

    def transfer_batch_to_device(self, batch: Frame, device: torch.device, dataloader_idx: int) -> Frame:
        """The frame on the device (Lightning itself cannot move a frozen dataclass)."""
        with phase("data"):
            return to_device(batch, device)


def _masked(log: DrivingLog, train: Frames, hood: float | None, dirt: float | None) -> DrivingLog:
    """Return the log whose frames have in ``ego`` what training frames show of hoods and dirt, from these shares on."""
    sweeps, tracks = log.sweeps, log.tracks
    hoods = {} if hood is None else log.kept.get("hoods", (), lambda: find_hoods(train, sweeps), Hood)
    hidden = {camera: found.mask for camera, found in hoods.items() if hood is not None and found.share >= hood}
    seen = with_ego(train, hidden)
    spots = {} if dirt is None else log.kept.get("dirt", (), lambda: find_dirt(seen, sweeps, tracks), Hood)
    for camera, found in spots.items():
        if dirt is not None and float(found.mask.float().mean()) >= dirt:
            hidden[camera] = found.mask | hidden[camera] if camera in hidden else found.mask
    return replace(log, frames=with_ego(log.frames, hidden), hoods=hoods or log.hoods, dirt=spots or log.dirt)
