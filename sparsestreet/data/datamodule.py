"""Frames in the order that training and validation want them."""

from collections.abc import Iterator, Sequence

import torch
from lightning import LightningDataModule

from sparsestreet.data.device import to_device
from sparsestreet.data.log import DrivingLog, split
from sparsestreet.types import Frame


class ShuffledFrames:
    """All frames in a new random order each epoch, given by seed and epoch alone; endless if asked again and again.

    An iterator that is dropped half way is taken up again by the next one, and the place is part of checkpoints
    (Lightning asks for ``state_dict``): a resumed training sees the frames that an uninterrupted one would have seen.
    """

    def __init__(self, frames: Sequence[Frame], seed: int) -> None:
        self.frames = frames
        self.seed = seed
        self.epoch = 0
        self.position = 0

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        if self.position >= len(self.frames):
            self.epoch, self.position = self.epoch + 1, 0
        order = self._order()
        while self.position < len(self.frames):
            self.position += 1
            yield self.frames[order[self.position - 1]]

    def _order(self) -> list[int]:
        # One stream of the seed, of which epoch e takes the e-th permutation: seeds 0 and 1 share no epoch.
        generator = torch.Generator().manual_seed(self.seed)
        for _ in range(self.epoch):
            torch.randperm(len(self.frames), generator=generator)
        return torch.randperm(len(self.frames), generator=generator).tolist()

    def state_dict(self) -> dict[str, int]:
        return {"epoch": self.epoch, "position": self.position}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.epoch, self.position = state["epoch"], state["position"]


class OrderedFrames:
    """Frames as they come, from the start each time. (Lightning takes a bare tuple for several loaders.)"""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self.frames = frames

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)


class StreetData(LightningDataModule):
    """A log, split into frames to train on and frames to hold out; each batch is one Frame.

    The loaders are plain iterables: frames lie in memory, so that worker processes would only copy them.
    """

    def __init__(self, log: DrivingLog, *, stride: int = 10, offset: int = 5, seed: int = 0) -> None:
        super().__init__()
        self.driving_log = log
        self.split = split(log, stride=stride, offset=offset)
        self.seed = seed

    def train_dataloader(self) -> ShuffledFrames:
        """One training frame a step; an epoch is all of them in random order."""
        return ShuffledFrames(self.split.train, self.seed)

    def val_dataloader(self) -> OrderedFrames:
        """The held-out frames in the order of the log."""
        return OrderedFrames(self.split.held_out)

    def transfer_batch_to_device(self, batch: Frame, device: torch.device, dataloader_idx: int) -> Frame:
        """The frame on the device (Lightning itself cannot move a frozen dataclass)."""
        return to_device(batch, device)
