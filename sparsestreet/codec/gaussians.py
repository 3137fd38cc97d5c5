"""A block of Gaussians as bytes: each column with a step of its own, finer where a Gaussian shows more.

What an error of a Gaussian does to a picture is in proportion to its opacity. With squared errors counted, the best
steps for the same number of bytes then grow with the inverse root of the opacity. So they do here, for shapes and
colors, in steps of sqrt(2) from 1 at opacity 1 to 16 where it rounds to 0. Positions, which Morton's curve needs on one
grid, have one step in a block. Opacities come first, so that a reader knows the steps of the others.

An order of rows is not kept. Errors, in the worst case: a coordinate step / 2; a logarithm of a scale and a part of a
Rodrigues vector step / 2 times the growth, which turns an axis by at most sqrt(3) step growth radians; an opacity
1 / 254; a harmonic, along each principal axis, 0.6 step growth.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int16, Int64, Shaped

from sparsestreet.codec import arrays, vectors
from sparsestreet.codec.arrays import Cursor, packed_column, unpacked_column

LEVELS = 127
"""Of opacities between 0 and 1."""
_GRADES = 8
_DEAD_ZONE = 0.1
"""Share of a step by which a harmonic must be nearer to the next value to be taken for it: fewer bytes for its error
than a larger step would give."""


@dataclass(frozen=True)
class Steps:
    """How fine numbers are kept."""

    position: float
    """Meters."""
    log_scale: float = 1 / 32
    rotation: float = 1 / 128
    """Of Rodrigues vectors."""
    color: float = 1 / 112
    """Of coefficients; 0.282 times that is a color's."""


@dataclass(frozen=True)
class Block:
    """Rows of one table."""

    means: Float64[np.ndarray, "n 3"]
    log_scales: Float64[np.ndarray, "n 3"]
    quaternions: Float64[np.ndarray, "n 4"]
    """wxyz, of any length; unit ones come back."""
    opacity_logits: Float64[np.ndarray, " n"]
    harmonics: Float64[np.ndarray, "n d"]
    """All coefficients of a row, the three colors of each together."""
    others: Mapping[str, Shaped[np.ndarray, "n ..."]]
    """What else a row has."""

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class Form:
    """What a reader must know of a table before its blocks; the same for all of them."""

    axes: Int16[np.ndarray, "d d"]
    """Principal axes of the harmonics."""
    named_axes: bool
    """Whether the axes of ellipsoids keep their names and directions, because something is added to them later."""
    others: Mapping[str, "OtherColumn"]


@dataclass(frozen=True)
class OtherColumn:
    """A column beyond those that each Gaussian has."""

    dtype: str
    """``float32``, or a type of integers."""
    shape: tuple[int, ...]
    """Of a row."""
    step: float | None = None
    """Of a float32 column; None: bit for bit."""


def packed_block(block: Block, form: Form, steps: Steps) -> list[bytes]:
    """Return the bytes of a block in pieces, a column each. Its means must fit a grid of this step (``fits``)."""
    order, parts = vectors.packed_points(block.means, steps.position)
    opacities = 1 / (1 + np.exp(-np.clip(block.opacity_logits[order], -80, 80)))
    levels = np.rint(LEVELS * opacities).astype(np.int64)
    # Rows of one grade together, so that zstd meets each step's statistics once.
    grouped = np.argsort(_grades(levels), kind="stable")
    growth, order = _growth(levels[grouped]), order[grouped]
    pieces = [
        len(block).to_bytes(4, "little"),
        *parts,
        *arrays.packed(levels[:, None]),
        *_packed_shapes(block.log_scales[order], block.quaternions[order], growth, form.named_axes, steps),
        np.float64(steps.color).tobytes(),
        *arrays.packed(_colors(block.harmonics[order], form.axes, steps.color * growth)),
    ]
    for name, column in form.others.items():
        pieces += packed_column(block.others[name][order], column.step)
    return pieces


def rows_in(content: bytes) -> int:
    """Return the number of rows of a block, known before it is unpacked."""
    return int.from_bytes(Cursor(content).take(4), "little")


def unpacked_block(content: bytes, form: Form) -> Block:
    """Return the rows that ``packed_block`` was given, in another order. Raises ValueError for damaged bytes."""
    cursor = Cursor(content)
    rows, size = int.from_bytes(cursor.take(4), "little"), len(form.axes)
    with np.errstate(all="ignore"):  # a damaged number overflows; the check below says so
        means = vectors.unpacked_points(cursor, rows)
        levels = arrays.unpacked(cursor, rows, 1)[:, 0]
        if rows and not 0 <= levels.min() <= levels.max() <= LEVELS:
            raise ValueError("an opacity lies outside 0 to 1: it is damaged")
        grouped = np.argsort(_grades(levels), kind="stable")
        growth = _growth(levels[grouped])
        log_scales, quaternions = _unpacked_shapes(cursor, growth, form.named_axes)
        (color,) = cursor.numbers("<d")
        colors = vectors.from_axes(arrays.unpacked(cursor, rows, size) * (color * growth), form.axes)
        others = {
            name: unpacked_column(cursor, rows, column.shape, column.dtype, column.step)
            for name, column in form.others.items()
        }
    cursor.finish()
    block = Block(means[grouped], log_scales, quaternions, _logits(levels[grouped]), colors, others)
    if not all(np.isfinite(values).all() for values in (block.means, block.log_scales, block.quaternions, colors)):
        raise ValueError("a number is not finite: it is damaged")
    return block


def _grades(levels: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Return how often an opacity was halved, rounded, at most ``_GRADES`` times."""
    table = np.rint(-np.log2(np.maximum(np.arange(LEVELS + 1), 0.5) / LEVELS)).astype(np.int64)
    return np.minimum(table, _GRADES)[levels]


def _growth(levels: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 1"]:
    return 2.0 ** (_grades(levels)[:, None] / 2)


def _logits(levels: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    # A fourth of a step inside the ends, whose logits are infinite.
    opacities = np.clip(levels, 0.25, LEVELS - 0.25) / LEVELS
    return np.log(opacities) - np.log1p(-opacities)


def _colors(
    values: Float64[np.ndarray, "n d"], axes: Int16[np.ndarray, "d d"], step: Float64[np.ndarray, "n 1"]
) -> Int64[np.ndarray, "n d"]:
    scaled = vectors.along_axes(values, axes) / step
    return (np.sign(scaled) * np.floor(np.abs(scaled) + 0.5 - _DEAD_ZONE)).astype(np.int64)


def _packed_shapes(
    log_scales: Float64[np.ndarray, "n 3"],
    quaternions: Float64[np.ndarray, "n 4"],
    growth: Float64[np.ndarray, "n 1"],
    named: bool,
    steps: Steps,
) -> list[bytes]:
    if named:
        lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
        turns = quaternions / np.where(lengths > 0, lengths, 1)
    else:
        turns, orders = vectors.nearest_turn(quaternions)
        log_scales = np.take_along_axis(log_scales, orders, axis=1)
    scales = np.rint(log_scales / (steps.log_scale * growth)).astype(np.int64)
    numbers = np.rint(turns / (steps.rotation * growth)).astype(np.int64)
    return [np.array([steps.log_scale, steps.rotation]).tobytes(), *arrays.packed(np.hstack([scales, numbers]))]


def _unpacked_shapes(
    cursor: Cursor, growth: Float64[np.ndarray, "n 1"], named: bool
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 4"]]:
    log_scale, rotation = cursor.numbers("<2d")
    table = arrays.unpacked(cursor, len(growth), 7 if named else 6)
    turns = table[:, 3:] * (rotation * growth)
    if not named:
        return table[:, :3] * (log_scale * growth), vectors.quaternions_of(turns)
    lengths = np.linalg.norm(turns, axis=1, keepdims=True)
    return table[:, :3] * (log_scale * growth), turns / np.where(lengths > 0, lengths, 1)
