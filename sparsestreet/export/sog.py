"""``.sog``, version 2: PlayCanvas' format of one frame, "Spatially Ordered Gaussians".

A zip of ``meta.json`` and lossless WebP images of 8 bits, in which a Gaussian is a pixel, the same in each image
(developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog). Where the description and PlayCanvas' programs
differ, we do as the programs do (splat-transform 2.7.1): axes are those of a .ply, x right, y down, z ahead; scales are
logarithms; the alphas 252 to 255 of a quaternion mean that w, x, y or z is the largest part.
"""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from PIL import Image

from sparsestreet.atomic import atomic_file
from sparsestreet.codec.limits import Budget
from sparsestreet.codec.positions import curve_order
from sparsestreet.export.codebooks import nearest_numbers, number_book, vector_book
from sparsestreet.export.ply import check_gaussians
from sparsestreet.geometry import quaternions as quat
from sparsestreet.types import Gaussians

VERSION = 2
LARGEST_COUNT = 10_000_000
"""Gaussians; an image of WebP could hold 16,383 x 16,383."""

_BOOK = 256
"""Entries of a codebook."""
_PALETTE = 65_536
"""Entries of the palette of harmonics, at most: a label has 16 bits."""
_ROWS_A_COLOR = 8
"""Gaussians for each entry of the palette, at least."""
_ACROSS = 64
"""Entries of the palette in a row of its image."""
_META, _META_BYTES = "meta.json", 2**20
_FIRST_ALPHA = 252


def write_sog(path: Path, gaussians: Gaussians, *, antialiased: bool = False) -> int:
    """Writes Gaussians with x right, y down, z ahead; returns their number; the whole file or nothing.

    Rounding: 65,536 steps of sign(x) log(1 + |x|) along each axis, log scales and the first harmonic to the nearest of
    256 numbers, opacities 1 / 510, three parts of quaternions 0.0028, the other harmonics together to one of 65,536 or
    fewer colors, whose numbers are of 256. Raises ValueError for more than ``LARGEST_COUNT`` Gaussians or numbers that
    are not finite.
    """
    check_gaussians(gaussians)
    if len(gaussians) > LARGEST_COUNT:
        raise ValueError(
            f"a .sog holds at most {LARGEST_COUNT:,} Gaussians, got {len(gaussians):,}: prune, or choose nodes"
        )
    means, sh = gaussians.means.double().numpy(), gaussians.sh.double().numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    order = curve_order(logs)
    scales = np.log(np.maximum(gaussians.scales.double().numpy()[order], 1e-30))
    opacities = gaussians.opacities.double().numpy()[order]
    low, high = (logs.min(0), logs.max(0)) if len(logs) else (np.zeros(3), np.ones(3))
    steps = np.rint((logs[order] - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.int64)
    scale_book, color_book = (number_book(values.reshape(-1), _BOOK) for values in (scales, sh[order, 0]))
    tables = {
        "means_l": steps & 255,
        "means_u": steps >> 8,
        "quats": _rotations(quat.normalized(gaussians.quaternions.double()).numpy()[order]),
        "scales": nearest_numbers(scales, scale_book),
        "sh0": np.hstack([nearest_numbers(sh[order, 0], color_book), np.rint(255 * opacities)[:, None]]),
    }
    images = {f"{name}.webp": _image(_square(table)) for name, table in tables.items()}
    meta = {
        "version": VERSION,
        "asset": {"generator": "sparsestreet"},
        "count": len(gaussians),
        "antialias": antialiased,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book.tolist(), "files": ["sh0.webp"]},
    }
    if sh.shape[1] > 1 and len(sh):
        found, more = _palette(gaussians.sh[order, 1:].float(), gaussians.opacities[order].float())
        meta["shN"], images = found, images | more
    with atomic_file(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in {_META: json.dumps(meta).encode(), **images}.items():
            archive.writestr(zipfile.ZipInfo(name), content)  # without the time of writing
    return len(gaussians)


def read_sog(path: Path) -> Gaussians:
    """Returns the Gaussians of such a file, x right, y down, z ahead, in the order of its pixels.

    Raises ValueError for one that is none, is damaged, or would take more memory than its size allows
    (``codec.limits``), before memory is taken.
    """
    with path.open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                return _Reader(archive, Budget(path.stat().st_size)).gaussians()
        except Exception as error:  # each part of a broken archive fails in its own way
            reason = " ".join(str(error).split()) if isinstance(error, ValueError) else repr(error)[:200]
            raise ValueError(f"{path} is no .sog or is damaged: {reason}") from error


class _Reader:
    """What is in an archive, asked for once its size is known."""

    def __init__(self, archive: zipfile.ZipFile, budget: Budget) -> None:
        self._archive, self._budget = archive, budget
        self.meta = json.loads(self._content(_META, _META_BYTES))
        version, self.count = self.meta.get("version"), self.meta["count"]
        if version != VERSION:
            raise ValueError(f"it has version {version!r} of the format, this program reads {VERSION}")
        if type(self.count) is not int or not 0 <= self.count <= LARGEST_COUNT:
            raise ValueError(f"it has 0 to {LARGEST_COUNT:,} Gaussians, got {self.count!r}")

    def gaussians(self) -> Gaussians:
        terms = (self.meta["shN"]["bands"] + 1) ** 2 if "shN" in self.meta else 1
        if terms not in (1, 4, 9, 16):
            raise ValueError(f"harmonics have 1 to 3 bands, got {self.meta['shN']['bands']!r}")
        self._budget.take(16 * (11 + 3 * terms) * self.count)
        low, high = (_numbers(self.meta["means"][end], 3) for end in ("mins", "maxs"))
        lower, upper = (self._rows("means", place)[:, :3].astype(float) for place in (0, 1))
        logs = low + (256 * upper + lower) / 65535 * (high - low)
        colors, scales = self._rows("sh0"), self._rows("scales")[:, :3]
        first = self._book("sh0")[colors[:, :3]][:, None]
        with np.errstate(over="ignore"):  # the check below says so
            values = (
                np.sign(logs) * np.expm1(np.abs(logs)),
                _from_rotations(self._rows("quats")),
                np.exp(self._book("scales")[scales]),
                colors[:, 3] / 255,
                np.concatenate([first, self._harmonics(terms)], axis=1) if terms > 1 else first,
            )
            tensors = [torch.from_numpy(value.astype(np.float32)) for value in values]
        if not all(bool(tensor.isfinite().all()) for tensor in tensors):
            raise ValueError("a number is not finite")
        return Gaussians(*tensors)

    def _harmonics(self, terms: int) -> Float[np.ndarray, "n k 3"]:
        count, wide = self.meta["shN"]["count"], _ACROSS * (terms - 1)
        image = self._pixels("shN", 0)
        if type(count) is not int or image.shape[1] != wide or not 0 <= count <= image.shape[0] * _ACROSS:
            raise ValueError(f"a palette of {count!r} entries is {wide} pixels wide, got {image.shape[:2]}")
        places = self._rows("shN", 1)[:, :2].astype(np.int64) @ np.array([1, 256])
        if (places >= count).any():
            raise ValueError(f"a label is {places.max()}, the palette has {count} entries")
        book = self._book("shN").astype(np.float32)
        return book[image[..., :3].reshape(-1, terms - 1, 3)][places]

    def _rows(self, part: str, place: int = 0) -> UInt8[np.ndarray, "n 4"]:
        """Returns a pixel for each Gaussian."""
        found = self._pixels(part, place).reshape(-1, 4)
        if len(found) < self.count:
            raise ValueError(f"{self.count} Gaussians need as many pixels, an image of {part} has {len(found)}")
        return found[: self.count]

    def _pixels(self, part: str, place: int) -> UInt8[np.ndarray, "h w 4"]:
        content = self._content(self.meta[part]["files"][place])
        width, height = _webp_size(content)
        self._budget.take(16 * width * height)  # four times RGBA: the decoder has two of them
        with Image.open(io.BytesIO(content), formats=["WEBP"]) as image:
            return np.asarray(image.convert("RGBA"))

    def _content(self, name: str, most: int | None = None) -> bytes:
        entry = self._archive.getinfo(name)
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{name!r} is packed in a way that the format does not know")
        if most is not None and entry.file_size > most:
            raise ValueError(f"{name!r} has at most {most} bytes, got {entry.file_size}")
        self._budget.take(entry.file_size)
        with self._archive.open(entry) as file:
            return file.read(entry.file_size + 1)

    def _book(self, part: str) -> Float64[np.ndarray, " 256"]:
        return _numbers(self.meta[part]["codebook"], _BOOK)


def _numbers(found: Any, count: int) -> Float64[np.ndarray, " n"]:
    values = np.asarray(found, np.float64)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{count} finite numbers belong into a list of meta.json, got one of shape {values.shape}")
    return values


def _webp_size(content: bytes) -> tuple[int, int]:
    """Returns width and height of a lossless WebP (RFC 9649, section 3.4), before any decoder takes memory."""
    if content[:4] != b"RIFF" or content[8:16] != b"WEBPVP8L" or content[20:21] != b"\x2f" or len(content) < 25:
        raise ValueError("an image is no lossless WebP")
    bits = int.from_bytes(content[21:25], "little")
    return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1


def _palette(harmonics: torch.Tensor, opacities: torch.Tensor) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Returns what meta.json says of all harmonics above the first, and two images."""
    count, terms, _ = harmonics.shape
    size = min(_PALETTE, max(count // _ROWS_A_COLOR, _ACROSS))
    colors, labels = vector_book(harmonics.flatten(1), opacities.clamp(min=1 / 255), size)
    numbers = colors.double().numpy()
    book = number_book(numbers.reshape(-1), _BOOK)
    image = np.zeros((math.ceil(len(numbers) / _ACROSS) * _ACROSS, terms, 3), np.uint8)
    image[: len(numbers)] = nearest_numbers(numbers, book).reshape(-1, terms, 3)
    places = labels.numpy()
    names = ["shN_centroids.webp", "shN_labels.webp"]
    said = {"count": len(numbers), "bands": math.isqrt(terms), "codebook": book.tolist(), "files": names}
    table = np.stack([places & 255, places >> 8, np.zeros_like(places)], axis=1)
    pictures = (image.reshape(-1, _ACROSS * terms, 3), _square(table))
    return said, {name: _image(picture) for name, picture in zip(names, pictures, strict=True)}


def _square(table: np.ndarray) -> UInt8[np.ndarray, "h w c"]:
    """Returns rows as pixels of an image about as wide as high."""
    width = max(4 * math.ceil(math.sqrt(len(table)) / 4), 4)
    image = np.zeros((max(math.ceil(len(table) / width), 1) * width, table.shape[1]), np.uint8)
    image[: len(table)] = table
    return image.reshape(-1, width, table.shape[1])


def _image(pixels: UInt8[np.ndarray, "h w c"]) -> bytes:
    buffer = io.BytesIO()
    # exact: colors count where alpha is 0. More effort (method 4, quality 100) takes 50 times as long, for nothing.
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True, method=2, quality=75)
    return buffer.getvalue()


def _rotations(unit: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Returns the three parts of w, x, y, z that are not the largest, and which one is."""
    largest = np.abs(unit).argmax(1)[:, None]
    unit = np.where(np.take_along_axis(unit, largest, 1) < 0, -unit, unit)
    others = unit[np.arange(4) != largest].reshape(-1, 3)
    return np.hstack([np.rint((others * np.sqrt(0.5) + 0.5) * 255), _FIRST_ALPHA + largest])


def _from_rotations(stored: UInt8[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    largest = stored[:, 3:].astype(np.int64) - _FIRST_ALPHA
    if (largest < 0).any():
        raise ValueError(f"the alpha of a quaternion lies in {_FIRST_ALPHA} to 255, got {stored[:, 3].min()}")
    others = (stored[:, :3] / 255 - 0.5) * np.sqrt(2.0)
    unit = np.empty((len(stored), 4))
    unit[np.arange(4) != largest] = others.reshape(-1)
    np.put_along_axis(unit, largest, np.sqrt(np.maximum(1 - (others**2).sum(1, keepdims=True), 0)), 1)
    return unit
