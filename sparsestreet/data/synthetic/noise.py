"""Band-limited randomness for textures: smooth value noise from a table, and random numbers per cell."""

import functools
import zlib

import numpy as np
from jaxtyping import Float32, Float64

_CELLS = 32
_TEXELS_PER_CELL = 32
_SIZE = _CELLS * _TEXELS_PER_CELL


def stream(seed: int, name: str) -> np.random.Generator:
    """Returns the random numbers of one element of the street; adding an element does not change the others.

    >>> stream(0, "houses").random() == stream(0, "houses").random()
    True
    """
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


@functools.cache
def _table() -> Float32[np.ndarray, " m"]:
    """Returns one tile of periodic value noise, mean 0 and standard deviation 1, fine enough to read unfiltered."""
    lattice = np.random.default_rng(20240229).standard_normal((_CELLS, _CELLS))
    rows = _interpolated(lattice)
    tile = _interpolated(np.ascontiguousarray(rows.T)).T
    return ((tile - tile.mean()) / tile.std()).astype(np.float32).ravel()


def _interpolated(values: Float64[np.ndarray, "a b"]) -> Float64[np.ndarray, "c b"]:
    """Interpolates rows periodically by the quintic fade of Perlin (2002), whose second derivative is continuous."""
    t = np.arange(_TEXELS_PER_CELL)[None, :, None] / _TEXELS_PER_CELL
    fade = t**3 * (t * (6 * t - 15) + 10)
    following = np.roll(values, -1, axis=0)
    return (values[:, None] * (1 - fade) + following[:, None] * fade).reshape(_SIZE, -1)


def smooth_noise(
    u: Float32[np.ndarray, " n"], v: Float32[np.ndarray, " n"], cell: float, footprint: Float32[np.ndarray, " n"]
) -> Float32[np.ndarray, " n"]:
    """Returns noise with features of ``cell`` meters, faded out if a pixel's ``footprint`` (meters) is half a cell."""
    scale = np.float32(_TEXELS_PER_CELL / cell)
    column = np.floor(u * scale).astype(np.int32) & (_SIZE - 1)
    row = np.floor(v * scale).astype(np.int32) & (_SIZE - 1)
    fade = np.clip(np.float32(1.5) - footprint * np.float32(2 / cell), 0, 1)
    return _table()[row * _SIZE + column] * fade


def cell_random(
    column: Float32[np.ndarray, " n"], row: Float32[np.ndarray, " n"], seed: int
) -> Float32[np.ndarray, " n"]:
    """Returns a number in [0, 1) that depends only on the integer cell and the seed (a multiply-xorshift hash)."""
    with np.errstate(over="ignore"):
        h = column.astype(np.int32).view(np.uint32) * np.uint32(0x9E3779B1)
        h ^= row.astype(np.int32).view(np.uint32) * np.uint32(0x85EBCA77)
        h += np.uint32(seed & 0xFFFFFFFF)
        h ^= h >> np.uint32(15)
        h *= np.uint32(0x2C1B3C6D)
        h ^= h >> np.uint32(12)
        h *= np.uint32(0x297A2D39)
        h ^= h >> np.uint32(15)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)
