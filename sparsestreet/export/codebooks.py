"""Codebooks: a few values that stand for many, found by k-means (Lloyd 1982).

Of numbers, k-means is cheap: sorted, each entry of the book owns a stretch of them. Of vectors it is done twice, on a
coarse level and within each of its parts, because 65,536 entries are too many to compare with.
"""

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor

_PARTS = 256
"""Of the coarse level."""
_ROUNDS = 10
_NUMBER_ROUNDS = 100
_CHUNK = 65_536
"""Rows that are compared with all entries at a time; also those that the coarse level is learned from."""
_BINS = 4096


def number_book(values: Float64[np.ndarray, " n"], size: int) -> Float64[np.ndarray, " s"]:
    """Returns ``size`` numbers, increasing, of which one is near each value; zeros where there is no value.

    It starts where the density of entries is the cube root of that of the values, which is best for many entries
    (Panter and Dite 1951).
    """
    if not len(values):
        return np.zeros(size)
    ordered = np.sort(values)
    sums = np.concatenate([[0.0], np.cumsum(ordered - ordered[0])])
    book = _spread(ordered, size)
    for _ in range(_NUMBER_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (book[1:] + book[:-1]) / 2), [len(ordered)]])
        counts = np.diff(ends)
        means = (sums[ends[1:]] - sums[ends[:-1]]) / np.maximum(counts, 1) + ordered[0]
        moved = np.where(counts > 0, means, book)
        if np.array_equal(moved, book):
            break
        book = np.maximum.accumulate(moved)
    return book


def nearest_numbers(
    values: Float[np.ndarray, "*shape"], book: Float64[np.ndarray, " s"]
) -> Int64[np.ndarray, "*shape"]:
    """Returns the place of the nearest entry of an increasing book for each value."""
    return np.searchsorted((book[1:] + book[:-1]) / 2, values)


def vector_book(
    vectors: Float32[Tensor, "n d"], weights: Float32[Tensor, " n"], size: int
) -> tuple[Float32[Tensor, "s d"], Int64[Tensor, " n"]]:
    """Returns at most ``size`` vectors, and for each row the place of one that is near it.

    ``weights``, above 0, say how much an error of a row counts. The same numbers give the same book on one machine.
    Entries of one part of the coarse level follow each other. Rows are kept as they are where there are no more than
    ``size``.
    """
    if len(vectors) <= size:
        return vectors, torch.arange(len(vectors))
    generator = torch.Generator().manual_seed(0)
    coarse = _learned(*_sample(vectors, weights, generator), min(_PARTS, size), generator)
    owner, distances = _nearest(vectors, coarse)
    counts = torch.bincount(owner, minlength=len(coarse))
    shares = _shares(torch.zeros(len(coarse)).index_add_(0, owner, weights * distances), counts, size)
    books, labels, first = [], torch.empty(len(vectors), dtype=torch.int64), 0
    for rows, share in zip(torch.argsort(owner, stable=True).split(counts.tolist()), shares, strict=True):
        if len(rows):
            own = vectors[rows]
            book = own if share >= len(own) else _learned(own, weights[rows], share, generator)
            used, place = torch.unique(_nearest(own, book)[0], return_inverse=True)
            labels[rows] = first + place
            books.append(book[used])
            first += len(used)
    return torch.cat(books), labels


def _spread(ordered: Float64[np.ndarray, " n"], size: int) -> Float64[np.ndarray, " s"]:
    counts, edges = np.histogram(ordered, bins=_BINS)
    places = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    return np.interp((np.arange(size) + 0.5) / size * places[-1], places, edges)


def _sample(vectors: Tensor, weights: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    if len(vectors) <= _CHUNK:
        return vectors, weights
    rows = torch.randperm(len(vectors), generator=generator)[:_CHUNK].sort().values
    return vectors[rows], weights[rows]


def _learned(vectors: Tensor, weights: Tensor, size: int, generator: torch.Generator) -> Tensor:
    """Returns ``size`` vectors, or all where there are no more, after some rounds of k-means.

    It starts from rows that are drawn with their weighted squares from the mean, so that many equal rows do not crowd
    out the others.
    """
    if len(vectors) <= size:
        return vectors
    chances = weights * (vectors - vectors.mean(0)).square().sum(1)
    start = torch.multinomial(chances.double() + 1e-12, size, generator=generator)
    book = vectors[start]
    for _ in range(_ROUNDS):
        owner, _ = _nearest(vectors, book)
        mass = torch.zeros(size).index_add_(0, owner, weights)[:, None]
        moved = torch.zeros_like(book).index_add_(0, owner, weights[:, None] * vectors)
        book = torch.where(mass > 0, moved / mass.clamp(min=1e-30), book)
    return book


def _nearest(vectors: Tensor, book: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the place of the nearest entry for each row, and its squared distance."""
    half = book.square().sum(1) / 2
    labels = [torch.argmax(torch.addmm(-half, rows, book.T), 1) for rows in vectors.split(_CHUNK)]
    owner = torch.cat(labels)
    return owner, (vectors - book[owner]).square().sum(1)


def _shares(errors: Tensor, counts: Tensor, size: int) -> list[int]:
    """Returns how many entries each part gets: by its error, as all cells of a good book have the same, and no more
    than its rows."""
    shares = counts.clamp(max=1)
    while True:
        wanting = torch.where(shares < counts, errors.double() + 1e-30, 0.0)
        more = (int(size - shares.sum()) * wanting / wanting.sum().clamp(min=1e-300)).long()
        if not bool(more.any()):
            return shares.tolist()
        shares = torch.minimum(shares + more, counts)
