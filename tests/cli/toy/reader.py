"""A reader of one's own: a log from a folder of pictures."""

from dataclasses import dataclass
from pathlib import Path

import torch

from sparsestreet.data.images import check_pixels, image_size, read_image
from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import LogError, Problem, attempt
from sparsestreet.data.reader import FolderSignature, LogReader
from sparsestreet.data.timestamps import LogClock
from sparsestreet.types import Camera, Frame, View


@dataclass(frozen=True)
class PicturesReader(LogReader):
    """000.png, 001.png ...: one camera that drives ahead, a meter a picture."""

    marks = FolderSignature(("000.png",))

    root: Path | str
    focal: float
    """Pixels."""

    @property
    def folder(self) -> Path:
        return Path(self.root)

    def check(self) -> list[Problem]:
        paths = sorted(self.folder.glob("*.png"))
        problems = [] if paths else [Problem(self.folder, "there is no picture", "write 000.png, 001.png ...")]
        for path in paths:
            attempt(problems, lambda path=path: check_pixels(path, decode=True))
        return problems

    def read(self) -> DrivingLog:
        if problems := self.check():
            raise LogError(problems)
        count = len(list(self.folder.glob("*.png")))
        views = [LogClock(count).view(self._camera(index), index, 0) for index in range(count)]
        no_shift = torch.eye(4, dtype=torch.float64)
        return DrivingLog(self.folder.name, Frames(views, self._frame), Sweeps.of(()), (), count, 1, no_shift)

    def _camera(self, index: int) -> Camera:
        width, height = image_size(self._path(index))
        intrinsics = torch.tensor([[self.focal, 0, width / 2], [0, self.focal, height / 2], [0, 0, 1]])
        camera_from_world = torch.eye(4)
        camera_from_world[2, 3] = -float(index)
        return Camera(camera_from_world, intrinsics, width, height)

    def _frame(self, view: View) -> Frame:
        image = read_image(self._path(view.indices[0]), (view.camera.width, view.camera.height))
        return Frame.of(view, image=image)

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:03d}.png"
