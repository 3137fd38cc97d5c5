"""A drive on disk whose files cost what those of a camera cost: noise with the spectrum of photographs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from sparsestreet.atomic import atomic_folder
from sparsestreet.data.encoded import jpeg, mask_png, number_lines

_QUALITY = 85
_FALLOFF = 1.2
"""Of the amplitude with the frequency: about 1/f in photographs (Field, JOSA A 1987), here a bit steeper, so that a
1920x1280 JPEG takes about a megabyte."""


@dataclass(frozen=True)
class MadeUpDrive:
    """One camera that drives along z at a meter a frame."""

    images: int
    width: int
    height: int
    returns: int
    """Of a sweep."""

    def write(self, folder: Path, say: Callable[[str], None]) -> None:
        """In DriveStudio's layout (nuScenes' flavor), unless the folder is there."""
        if folder.exists():
            return
        say(f"writing {self.images} images of {self.width}x{self.height} into {folder}")
        canvas, generator = self._canvas(), np.random.default_rng(1)
        with atomic_folder(folder) as partial:
            intrinsics = np.array([self.width, self.width, self.width / 2, self.height / 2, 0, 0, 0, 0, 0], float)
            _write(partial / "intrinsics/0.txt", number_lines(intrinsics))
            for frame in range(self.images):
                top, left = generator.integers(0, (self.height, self.width))
                window = canvas[top : top + self.height, left : left + self.width]
                self._write_frame(partial, frame, window, generator)

    def _canvas(self) -> UInt8[np.ndarray, "h w 3"]:
        """Twice as wide and high as an image, which is a window of it."""
        gray, *tints = (_field(2 * self.height, 2 * self.width, seed) for seed in range(4))
        return np.stack([128 + 45 * gray + 12 * tint for tint in tints], -1).clip(0, 255).astype(np.uint8)

    def _write_frame(
        self, folder: Path, frame: int, window: UInt8[np.ndarray, "h w 3"], generator: np.random.Generator
    ) -> None:
        pose = np.eye(4)
        pose[2, 3] = frame
        _write(folder / f"images/{frame:03d}_0.jpg", jpeg(window, _QUALITY))
        for kind, bright in (
            ("sky_masks", 190),
            ("fine_dynamic_masks/human", 225),
            ("fine_dynamic_masks/vehicle", 210),
        ):
            _write(folder / kind / f"{frame:03d}_0.png", mask_png(window[..., 0] > bright))
        _write(folder / f"extrinsics/{frame:03d}_0.txt", number_lines(pose))
        _write(folder / f"lidar_pose/{frame:03d}.txt", number_lines(pose))
        points = np.zeros((self.returns, 4), "<f4")
        points[:, :3] = generator.uniform((-40, -2, -40), (40, 2, 40), (self.returns, 3))
        _write(folder / f"lidar/{frame:03d}.bin", points.tobytes())


def _field(height: int, width: int, seed: int) -> Float[np.ndarray, "h w"]:
    """Noise of mean 0 and variance 1."""
    generator = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    frequency[0, 0] = np.inf
    phases = generator.normal(size=(2, *frequency.shape))
    field = np.fft.irfft2((phases[0] + 1j * phases[1]) / frequency**_FALLOFF, (height, width))
    return field / field.std()


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
