"""Renders a scene along a camera path, as a video or as single pictures."""

import errno
import itertools
import re
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, cast

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
_MAX_SIDE = 16384
"""Pixels, of libx264."""
_MAX_CRF = 51
_SIGNALS = {-signal.SIGXFSZ: errno.EFBIG} if hasattr(signal, "SIGXFSZ") else {}
_FULL = "no space left on device"


def path_pictures(stored: StoredScene, path: CameraPath) -> Iterator[Picture]:
    """Yield one picture an instant with the images of its cameras side by side; each is rendered on demand.

    Pictures are sharp: no exposure blurs them, whatever the cameras of the path say.
    """
    for rig in path:
        images = [stored.render(replace(view, camera=replace(view.camera, exposure=0.0))).rgb for view in rig]
        yield side_by_side([(image.clamp(0, 1) * 255).round().byte().cpu().numpy() for image in images])


def side_by_side(images: Sequence[Picture]) -> Picture:
    """Return one row of images; lower images are centered between black bars.

    >>> side_by_side([np.zeros((4, 6, 3), np.uint8), np.zeros((2, 3, 3), np.uint8)]).shape
    (4, 9, 3)
    """
    height = max(image.shape[0] for image in images)

    def framed(image: Picture) -> Picture:
        above = (height - image.shape[0]) // 2
        return np.pad(image, ((above, height - image.shape[0] - above), (0, 0), (0, 0)))

    return np.concatenate([framed(image) for image in images], axis=1)


def check_destination(out: Path) -> None:
    """Raise ValueError for a name with an ending other than .mp4, ImportError for a .mp4 if ffmpeg is missing."""
    if out.suffix == ".mp4":
        _ffmpeg()
    elif out.suffix:
        raise ValueError(f"a video ends in .mp4, a folder of PNGs has no ending, got {out.name!r}")


def picture_size(path: CameraPath, rows: int = 1) -> tuple[int, int]:
    """Return width and height of the largest picture of a path, with so many rows of its cameras, pixels."""
    widths = [sum(view.camera.width for view in rig) for rig in path]
    return max(widths, default=0), rows * max((view.camera.height for rig in path for view in rig), default=0)


def check_size(width: int, height: int) -> None:
    """Raise ValueError for pictures, of so many pixels, that no .mp4 holds."""
    if max(width, height) > _MAX_SIDE:
        raise ValueError(
            f"a .mp4 has at most {_MAX_SIDE:,} pixels a side, got {width:,} x {height:,}: take a smaller width=, "
            "fewer cameras= or layers=, or give out=FOLDER for PNGs"
        )


def write_pictures(out: Path | str, pictures: Iterable[Picture], *, fps: float, quality: float = 7.0) -> int:
    """Write a .mp4 if ``out`` ends so, else a folder of PNGs, whole or not at all. Returns the number of pictures.

    Args:
        out: the file, or a folder that is new or empty.
        pictures: all of one size.
        fps: pictures a second of the video.
        quality: quality of the video, 1 to 10 (10 hardly loses anything).

    Raises ValueError for another ending, no pictures, pictures of different sizes or too large for a video, ImportError
    if ffmpeg is missing, OSError if nothing can be written or ffmpeg fails; what stood there before stays.
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
    check_size(width, height)
    rate = str(Fraction(fps).limit_denominator())
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate, "-i", "-", "-an"]
    # crf 0 is another profile, lossless, which hardly anything plays.
    crf = str(max(int((1 - quality / 10) * _MAX_CRF), 1))
    coded = ["-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", crf, "-profile:v", "high", *_FILTERS, *_STREAMABLE]

    def checked() -> Iterator[Picture]:
        for picture in itertools.chain([first], pictures):
            if picture.shape != first.shape:
                raise ValueError(f"pictures of a video have one size, got {picture.shape} after {first.shape}")
            yield _even(picture)

    count = _encoded([*source, *coded, "-f", "mp4", "-y", _named(path)], checked())
    kept = _frames_in(path)
    if kept != count:
        raise OSError(f"ffmpeg took {count} pictures, and {kept} of them are in its video: repeat the command")
    return count


def _encoded(arguments: Sequence[str], pictures: Iterable[Picture]) -> int:
    """Give the pictures to ffmpeg and return their number. Raises OSError, with its words, where it fails."""
    command, count = [_ffmpeg().get_ffmpeg_exe(), "-v", "warning", *arguments], 0
    with tempfile.TemporaryFile() as said:  # a file takes what it says: a pipe that nobody reads would stop it
        process = subprocess.Popen(
            # In a session of its own, so that Ctrl-C is ours alone.
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True
        )  # fmt: skip
        pipe = cast(BinaryIO, process.stdin)
        try:
            whole = True
            for picture in pictures:
                whole = _took(partial(pipe.write, picture.data))
                if not whole:
                    break
                count += 1
            whole = _took(pipe.close) and whole
            if (status := process.wait()) or not whole:
                raise _failure(status, said)
        finally:
            process.kill()
            process.wait()
            _took(pipe.close)
    return count


def _took(action: Callable[[], object]) -> bool:
    """Act on the pipe; whether a program is still at its other end. Where none is, its status says why."""
    try:
        action()
    except BrokenPipeError:
        return False
    return True


def _failure(status: int, said: BinaryIO) -> OSError:
    said.seek(0)
    lines = [re.sub(r"\[[^]]* @ [^]]*\] ", "", line) for line in said.read().decode(errors="replace").splitlines()]
    words = "; ".join(dict.fromkeys(filter(None, map(str.strip, lines))))
    number = errno.ENOSPC if _FULL in words.lower() else _SIGNALS.get(status)
    if number is not None:
        return OSError(number, "ffmpeg: no room for the video")
    how = f"was ended by signal {-status}" if status < 0 else f"failed with status {status}"
    return OSError(f"ffmpeg {how}, and no video was written: {words[:300] or 'it said nothing'}")


def _frames_in(path: Path) -> int:
    """Pictures in a video, which are counted and not decoded; 0 where ffmpeg cannot read it."""
    copied = ["-map", "0:v:0", "-c", "copy", "-f", "null", "-progress", "pipe:1", "-"]
    command = [_ffmpeg().get_ffmpeg_exe(), "-v", "error", "-nostdin", "-i", _named(path), *copied]
    done = subprocess.run(command, capture_output=True, check=False)
    counts = re.findall(rb"^frame=(\d+)", done.stdout, re.MULTILINE)
    return int(counts[-1]) if counts and done.returncode == 0 else 0


def _named(path: Path) -> str:
    """The path so that ffmpeg takes no part of it for a protocol or an option."""
    return f"file:{path.absolute()}"


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
