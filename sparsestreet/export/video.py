"""Renders a scene along a camera path, as a video or as single pictures."""

import itertools
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sparsestreet.atomic import atomic_file, atomic_folder
from sparsestreet.export.path import CameraPath
from sparsestreet.scene.storage import StoredScene

Picture = UInt8[np.ndarray, "_h _w 3"]

_COLORS = "color_primaries=bt709:color_trc=bt709:colorspace=bt709"
_FILTERS = ["-vf", f"scale=out_color_matrix=bt709,format=yuv420p,setparams={_COLORS}"]
"""States the color space in the file, because players guess differently without it."""
_STREAMABLE = ["-movflags", "+faststart"]


def path_pictures(stored: StoredScene, path: CameraPath) -> Iterator[Picture]:
    """Yields one picture an instant with the images of its cameras side by side; each is rendered on demand.

    Pictures are sharp: no exposure blurs them, whatever the cameras of the path say.
    """
    for rig in path:
        images = [stored.render(replace(view, camera=replace(view.camera, exposure=0.0))).rgb for view in rig]
        yield side_by_side([(image.clamp(0, 1) * 255).round().byte().cpu().numpy() for image in images])


def side_by_side(images: Sequence[Picture]) -> Picture:
    """Returns one row of images; lower images are centered between black bars.

    >>> side_by_side([np.zeros((4, 6, 3), np.uint8), np.zeros((2, 3, 3), np.uint8)]).shape
    (4, 9, 3)
    """
    height = max(image.shape[0] for image in images)

    def framed(image: Picture) -> Picture:
        above = (height - image.shape[0]) // 2
        return np.pad(image, ((above, height - image.shape[0] - above), (0, 0), (0, 0)))

    return np.concatenate([framed(image) for image in images], axis=1)


def check_destination(out: Path) -> None:
    """Raises ValueError for a name with an ending other than .mp4, ImportError for a .mp4 if ffmpeg is missing."""
    if out.suffix == ".mp4":
        _ffmpeg()
    elif out.suffix:
        raise ValueError(f"a video ends in .mp4, a folder of PNGs has no ending, got {out.name!r}")


def write_pictures(out: Path | str, pictures: Iterable[Picture], *, fps: float, quality: float = 7.0) -> int:
    """Writes a .mp4 if ``out`` ends so, else a folder of PNGs, whole or not at all. Returns the number of pictures.

    Args:
        out: the file, or a folder that is new or empty.
        pictures: all of one size.
        fps: pictures a second of the video.
        quality: quality of the video, 1 to 10 (10 hardly loses anything).

    Raises ValueError for another ending, no pictures or pictures of different sizes, ImportError if ffmpeg is missing,
    OSError if nothing can be written.
    """
    out = Path(out)
    check_destination(out)
    if out.suffix:
        with atomic_file(out) as temporary:
            return _write_video(temporary, pictures, fps, quality)
    with atomic_folder(out) as temporary:
        return _write_pngs(temporary, pictures)


def _write_video(path: Path, pictures: Iterable[Picture], fps: float, quality: float) -> int:
    pictures = iter(pictures)
    first = next(pictures, None)
    if first is None:
        raise ValueError("a video needs pictures, got none")
    height, width = (size + size % 2 for size in first.shape[:2])
    writer: Generator[None, Picture | None, None] = _ffmpeg().write_frames(
        str(path),
        (width, height),
        fps=float(fps),
        quality=quality,
        macro_block_size=1,
        output_params=[*_FILTERS, *_STREAMABLE],
    )
    count = 0
    with closing(writer):
        writer.send(None)
        for picture in itertools.chain([first], pictures):
            if picture.shape != first.shape:
                raise ValueError(f"pictures of a video have one size, got {picture.shape} after {first.shape}")
            writer.send(_even(picture))
            count += 1
    return count


def _write_pngs(folder: Path, pictures: Iterable[Picture]) -> int:
    count = 0
    for picture in pictures:
        Image.fromarray(picture).save(folder / f"{count:05d}.png")
        count += 1
    return count


def _even(picture: Picture) -> Picture:
    """Repeats a last odd row or column, because H.264 stores color for pairs of pixels."""
    height, width = picture.shape[:2]
    return np.ascontiguousarray(np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))


def _ffmpeg() -> ModuleType:
    try:
        import imageio_ffmpeg
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "a video needs imageio-ffmpeg, which is not installed: pip install 'sparsestreet[video]', or give "
            "out=FOLDER, without an ending, for PNGs"
        ) from error
    return imageio_ffmpeg
