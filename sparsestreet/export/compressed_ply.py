"""``.compressed.ply``: SuperSplat's format of one frame (blog.playcanvas.com/compressing-gaussian-splats).

A binary .ply with an element ``chunk`` of 18 floats for each 256 Gaussians, the bounds of their positions, log scales
and colors; an element ``vertex`` of four words of 32 bits for each; and an element ``sh`` of a byte a coefficient.
"""

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64, Integer, UInt32

from sparsestreet.atomic import atomic_file
from sparsestreet.codec.positions import curve_order
from sparsestreet.export.ply import ANTIALIASED, check_gaussians
from sparsestreet.export.spz import NOTED
from sparsestreet.geometry import quaternions as quat
from sparsestreet.types import Gaussians

CHUNK = 256
_CHUNK_FIELDS = [
    *(f"{side}_{axis}" for side in ("min", "max") for axis in "xyz"),
    *(f"{side}_scale_{axis}" for side in ("min", "max") for axis in "xyz"),
    *(f"{side}_{color}" for side in ("min", "max") for color in "rgb"),
]
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_XYZ = ((21, 2047), (11, 1023), (0, 2047))
"""Shift and largest value of x, y and z in a word."""
_FIRST = 0.5 / np.sqrt(np.pi)
_SH_SPAN = 8.0
"""Harmonics lie in -4 to 4."""


def compressed_ply_notes(gaussians: Gaussians) -> list[str]:
    """Return, in a line each, what the format keeps less of than one expects."""
    means = gaussians.means.double().numpy()
    order = curve_order(means)
    low, high, _ = _bounded(means[order])
    steps = ((high - low) / [most for _, most in _XYZ]).max(1) / 2
    if not len(steps) or steps.max() <= NOTED:
        return []
    rows = order[CHUNK * int(steps.argmax()) :][:CHUNK]
    away = np.linalg.norm(means[rows] - np.median(means[rows], 0), axis=1)
    return [
        f"positions are kept to {1000 * np.median(steps):,.3g} mm, near row {rows[away.argmax()]} to "
        f"{1000 * steps.max():,.3g} mm, because it lies {away.max():,.4g} m from its neighbors"
    ]


def write_compressed_ply(path: Path, gaussians: Gaussians, *, antialiased: bool = False) -> int:
    """Writes Gaussians with x right, y down, z ahead; returns their number; the whole file or nothing.

    Rounding is that of 256 neighbors along a curve: positions and log scales 1 / 2046 (y) or 1 / 4094 of their extent,
    colors 1 / 510 of theirs; opacities 1 / 510, parts of quaternions 0.0007, harmonics 1 / 64 in -4 to 4.
    """
    check_gaussians(gaussians)
    order = curve_order(gaussians.means.double().numpy())
    means = gaussians.means.double().numpy()[order]
    logs = np.log(np.maximum(gaussians.scales.double().numpy()[order], 1e-30)).clip(-20, 20)
    sh = gaussians.sh.double().numpy()[order]
    colors = sh[:, 0] * _FIRST + 0.5
    tables = [_bounded(values) for values in (means, logs, colors)]
    bounds = np.concatenate([edge for low, high, _ in tables for edge in (low, high)], axis=1)
    red, green, blue = (np.rint(255 * column).astype(np.uint32) for column in tables[2][2].T)
    alpha = np.rint(255 * gaussians.opacities.double().numpy()[order]).astype(np.uint32)
    words = (
        _word(tables[0][2]),
        _rotations(quat.normalized(gaussians.quaternions.double()).numpy()[order]),
        _word(tables[1][2]),
        (red << np.uint32(24)) | (green << np.uint32(16)) | (blue << np.uint32(8)) | alpha,
    )
    # All of red come first, as in a plain .ply.
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * (sh.shape[1] - 1))
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        file.write(_header(len(bounds), len(sh), rest.shape[1], antialiased))
        file.write(bounds.astype("<f4").tobytes())
        file.write(np.stack(words, axis=1).astype("<u4").tobytes())
        file.write(np.clip(np.floor((rest / _SH_SPAN + 0.5) * 256), 0, 255).astype(np.uint8).tobytes())
    return len(sh)


def read_compressed_ply(path: Path) -> Gaussians:
    """Returns the Gaussians of a file that this module wrote. Raises ValueError for any other."""
    content = path.read_bytes()
    head, found, _ = content[:8192].partition(b"end_header\n")
    start = len(head) + len(found)
    named = re.search(rb"^element vertex (\d{1,9})$", head, re.MULTILINE)
    count, rest = int(named[1]) if named else 0, head.count(b"property uchar f_rest_")
    chunks = -(-count // CHUNK)
    if (
        head + found not in [_header(chunks, count, rest, mip) for mip in (False, True)]
        or len(content) != start + 72 * chunks + (16 + rest) * count
    ):
        raise ValueError(f"{path} is no .compressed.ply of this program or is damaged")
    bounds = np.frombuffer(content, "<f4", 18 * chunks, start).reshape(chunks, 6, 3).astype(float)
    bounds = np.repeat(bounds, CHUNK, axis=0)[:count]
    words = np.frombuffer(content, "<u4", 4 * count, start + 72 * chunks).reshape(count, 4)
    harmonics = np.frombuffer(content, np.uint8, rest * count, start + 72 * chunks + 16 * count).reshape(count, rest)
    shares = [_shares(words[:, 0]), _shares(words[:, 2])]
    color = np.stack([words[:, 3] >> np.uint32(shift) & np.uint32(255) for shift in (24, 16, 8, 0)], axis=1) / 255
    placed = [bounds[:, 2 * i] + part * (bounds[:, 2 * i + 1] - bounds[:, 2 * i]) for i, part in enumerate(shares)]
    first = bounds[:, 4] + color[:, :3] * (bounds[:, 5] - bounds[:, 4])
    others = ((harmonics + 0.5) / 256 - 0.5) * _SH_SPAN
    sh = np.concatenate([((first - 0.5) / _FIRST)[:, None], others.reshape(count, 3, rest // 3).transpose(0, 2, 1)], 1)
    values = (placed[0], _from_rotations(words[:, 1]), np.exp(placed[1]), color[:, 3], sh)
    return Gaussians(*(torch.from_numpy(value).float() for value in values))


def _header(chunks: int, count: int, rest: int, antialiased: bool) -> bytes:
    comments = ["comment x right, y down, z ahead", *([ANTIALIASED] if antialiased else [])]
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in _CHUNK_FIELDS]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _WORDS)]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{index}" for index in range(rest))]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _bounded(
    values: Float64[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3"], Float64[np.ndarray, "n 3"]]:
    """Returns least and largest values of each chunk, as float32 has them, and the places between them, 0 to 1."""
    starts = np.arange(0, len(values), CHUNK)
    low = np.minimum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    high = np.maximum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    whole = np.repeat(np.maximum(high - low, 1e-12), CHUNK, axis=0)[: len(values)]
    return low, high, np.clip((values - np.repeat(low, CHUNK, axis=0)[: len(values)]) / whole, 0, 1)


def _word(shares: Float64[np.ndarray, "n 3"]) -> UInt32[np.ndarray, " n"]:
    word = np.zeros(len(shares), np.uint32)
    for axis, (shift, largest) in enumerate(_XYZ):
        word |= np.rint(shares[:, axis] * largest).astype(np.uint32) << np.uint32(shift)
    return word


def _shares(word: Integer[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    return np.stack([(word >> np.uint32(shift) & np.uint32(most)) / most for shift, most in _XYZ], axis=1)


def _rotations(unit: Float64[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    """Returns two bits for the place of the largest part among w, x, y, z, and ten for each other."""
    largest = np.abs(unit).argmax(1)
    unit = np.where(np.take_along_axis(unit, largest[:, None], 1) < 0, -unit, unit)
    word = largest.astype(np.uint32)
    for place in range(4):
        bits = np.clip(np.rint((unit[:, place] * np.sqrt(0.5) + 0.5) * 1023), 0, 1023).astype(np.uint32)
        word = np.where(largest == place, word, (word << np.uint32(10)) | bits)
    return word


def _from_rotations(word: Integer[np.ndarray, " n"]) -> Float[np.ndarray, "n 4"]:
    largest, rest, unit = word >> np.uint32(30), word.copy(), np.zeros((len(word), 4))
    for place in range(3, -1, -1):
        values = ((rest & np.uint32(1023)) / 1023 - 0.5) * np.sqrt(2.0)
        unit[:, place] = np.where(largest == place, 0, values)
        rest = np.where(largest == place, rest, rest >> np.uint32(10))
    others = np.sqrt(np.maximum(1 - (unit**2).sum(1), 0))
    np.put_along_axis(unit, largest[:, None].astype(np.int64), others[:, None], 1)
    return unit
