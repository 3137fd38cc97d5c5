"""Integers, points and other arrays come back, at odd sizes and with extreme values."""

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sparsestreet.codec import arrays as integers
from sparsestreet.codec import vectors
from sparsestreet.codec.arrays import TYPES, Cursor, packed_column, unpacked_column

SIZES = st.sampled_from([0, 1, 2, 7, 255, 256, 257])


def again(table: np.ndarray) -> np.ndarray:
    cursor = Cursor(b"".join(integers.packed(table)))
    found = integers.unpacked(cursor, *table.shape)
    cursor.finish()
    return found


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_integers_come_back(data: st.DataObject):
    shape = data.draw(SIZES), data.draw(st.integers(0, 4))
    limit = data.draw(st.sampled_from([1, 130, 70_000, 2**40, 2**63 - 1]))
    table = data.draw(arrays.arrays(np.int64, shape, elements=st.integers(-limit, limit)))
    assert np.array_equal(again(table), table)


def test_the_largest_and_least_integers_come_back():
    table = np.array([[2**63 - 1], [-(2**63)], [0], [2**63 - 1]])
    assert np.array_equal(again(table), table)


def test_neighbors_that_are_alike_cost_less():
    slow = np.arange(100_000, 104_000)[:, None]
    shuffled = np.random.default_rng(0).permutation(slow)
    sizes = [sum(len(zstandard.compress(piece)) for piece in integers.packed(table)) for table in (slow, shuffled)]
    assert sizes[0] < 100 < 4000 < sizes[1]
    assert np.array_equal(again(slow), slow)


@settings(max_examples=30, deadline=None)
@given(SIZES, st.sampled_from([1e-3, 0.1, 3.0]), st.integers(0, 5))
def test_points_come_back_within_half_a_step(rows: int, step: float, seed: int):
    points = np.random.default_rng(seed).uniform(-50, 80, (rows, 3))
    order, pieces = vectors.packed_points(points, step)
    assert np.array_equal(np.sort(order), np.arange(rows))
    found = vectors.unpacked_points(Cursor(b"".join(pieces)), rows)
    assert np.abs(found - points[order]).max(initial=0) <= step / 2 + 1e-12
    assert np.array_equal(np.sort(vectors.curve_order(points)), np.arange(rows))


def test_the_largest_grid_that_fits_and_the_first_that_does_not():
    corners = np.array([[0.0, 0, 0], [2.0**21 - 1.5, 5, 7]])
    assert vectors.fits(corners, 1.0)
    order, pieces = vectors.packed_points(corners, 1.0)
    found = vectors.unpacked_points(Cursor(b"".join(pieces)), 2)
    assert np.abs(found - corners[order]).max() <= 0.5
    assert not vectors.fits(corners * 1.01, 1.0)
    assert vectors.fits(corners[:0], 1e-9)


def test_the_order_of_rows_pays_for_itself():
    """The floor of n points in a box without an order: log2(n!) / n bits less (Stirling: log2 n - 1.44)."""
    points, step = np.random.default_rng(0).uniform(0, 100, (20_000, 3)), 0.01
    _, pieces = vectors.packed_points(points, step)
    packed = sum(len(zstandard.compress(piece, 19)) for piece in pieces) / len(points)
    floor = (3 * np.log2(100 / step) - np.log2(len(points)) + 1.44) / 8
    assert floor < packed < floor + 0.3  # zstd codes whole bytes


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("shape", [(0,), (1, 3), (257,), (5, 0), (3, 2, 2)])
def test_arrays_of_all_types_come_back_bit_for_bit(dtype: str, shape: tuple[int, ...]):
    values = (np.random.default_rng(0).normal(0, 100, shape)).astype(dtype)
    cursor = Cursor(b"".join(packed_column(values)))
    found = unpacked_column(cursor, shape[0], shape[1:], dtype)
    cursor.finish()
    assert found.dtype == values.dtype
    assert np.array_equal(found, values)


def test_arrays_with_a_step():
    values = np.random.default_rng(0).normal(0, 1, (257, 3)).astype(np.float32)
    found = unpacked_column(Cursor(b"".join(packed_column(values, 0.01))), 257, (3,), "float32", 0.01)
    assert np.abs(found - values).max() <= 0.005 + 1e-6


def test_types_and_numbers_that_are_none_are_refused():
    with pytest.raises(ValueError, match="got complex128"):
        packed_column(np.zeros(2, complex))
    for dtype, step in (("object", None), ("int64", 0.5)):
        with pytest.raises(ValueError, match="damaged"):
            unpacked_column(Cursor(bytes(100)), 2, (), dtype, step)
    with pytest.raises(ValueError, match="no uint8: it is damaged"):
        unpacked_column(Cursor(b"".join(packed_column(np.array([300])))), 1, (), "uint8")
    with pytest.raises(ValueError, match="a number of 9 bytes"):
        integers.unpacked(Cursor(bytes([9]) + bytes(100)), 1, 1)


def test_harmonics_come_back_and_the_first_axes_hold_the_energy():
    random = np.random.default_rng(0)
    # What real harmonics are like: three colors that vary together, and little else.
    values = np.repeat(random.normal(0, 1, (500, 4)), 3, axis=1) + 0.05 * random.normal(0, 1, (500, 12))
    axes = vectors.principal_axes(values.T @ values)
    along = vectors.along_axes(values, axes)
    np.testing.assert_allclose(vectors.from_axes(along, axes), values, atol=1e-9)
    energy = (along**2).mean(0)
    assert energy[:4].sum() > 0.99 * energy.sum()
    assert np.array_equal(vectors.unpacked_axes(Cursor(vectors.packed_axes(axes)), 12), axes)
