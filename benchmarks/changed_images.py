"""Change the images of a log in DriveStudio's layout as a camera would: exposure, white, vignetting, JPEG.

``python -m benchmarks.changed_images LOG OUT --walk 0.25 --mean 1.0`` writes the images anew and links all else. It
shares no code with what simulates these effects: its arithmetic is NumPy's and its images are OpenCV's.
"""

import argparse
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt8


@dataclass(frozen=True)
class Changes:
    """What happens to the light of an image, in this order, before it is stored in 8 bits."""

    walk: float = 0.0
    """EV, standard deviation over the drive of each camera's smooth random walk."""
    mean: float = 0.0
    """EV above which all images are exposed: what was below white is cut off there."""
    vignette: float = 0.0
    """Part of the light that is lost in the corners, with the square of the distance from the middle."""
    quality: int = 100
    """Of the JPEG files, without subsampling of colors."""
    seed: int = 0


def changed(image: UInt8[np.ndarray, "h w 3"], ev: float, vignette: float) -> UInt8[np.ndarray, "h w 3"]:
    """The image of 2**ev times the light, less what a vignette takes, cut off at white.

    >>> changed(np.array([[[0, 118, 200]]], np.uint8), 1.0, 0.0).tolist()
    [[[0, 162, 255]]]
    """
    stored = image / 255
    light = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4) * 2.0**ev
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    corner = (x / (width / 2) - 1) ** 2 + (y / (height / 2) - 1) ** 2
    light = np.minimum(light * (1 - vignette * corner / 2)[..., None], 1)
    stored = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(255 * stored).astype(np.uint8)


def walk(frames: int, size: float, generator: np.random.Generator) -> Float64[np.ndarray, " f"]:
    """A random walk over the frames, smoothed over nine of them, with mean zero and a standard deviation."""
    steps = np.pad(np.cumsum(generator.normal(size=frames)), 4, "edge")
    window = np.hanning(11)[1:-1]
    smooth = np.convolve(steps, window / window.sum(), "valid")
    smooth -= smooth.mean()
    return size * smooth / max(smooth.std(), 1e-9)


def write(log: Path, out: Path, changes: Changes) -> float:
    """Write the changed log; returns the share of its pixels that are white. Raises FileExistsError for a log there."""
    out.mkdir(parents=True)
    for part in log.iterdir():
        if part.name != "images":
            (out / part.name).symlink_to(part.resolve())
    (out / "images").mkdir()
    files = {tuple(map(int, re.findall(r"\d+", path.stem))): path for path in sorted((log / "images").iterdir())}
    frames, generator = sorted({frame for frame, _ in files}), np.random.default_rng(changes.seed)
    walks = {camera: walk(len(frames), changes.walk, generator) for camera in sorted({camera for _, camera in files})}
    jpeg = [cv2.IMWRITE_JPEG_QUALITY, changes.quality]
    jpeg += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    white = []
    for (frame, camera), path in files.items():
        ev = changes.mean + walks[camera][frames.index(frame)]
        image = changed(cv2.imread(str(path)), ev, changes.vignette)
        white.append((image >= 250).all(-1).mean())
        cv2.imwrite(str(out / "images" / f"{path.stem}.jpg"), image, jpeg)
    return float(np.mean(white))


def main() -> None:
    """Read the command line, write the log and say how much of it is white."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("out", type=Path)
    for name, kind in (("walk", float), ("mean", float), ("vignette", float), ("quality", int), ("seed", int)):
        parser.add_argument(f"--{name}", type=kind, default=getattr(Changes, name))
    said = vars(parser.parse_args())
    share = write(said.pop("log"), out := said.pop("out"), Changes(**said))
    print(f"{out}: {100 * share:.1f} % of the pixels are white")


if __name__ == "__main__":
    main()
