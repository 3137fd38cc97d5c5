"""Codebooks against SciPy's k-means and a search of all entries."""

import numpy as np
import pytest
import torch
from scipy.cluster.vq import kmeans2

from sparsestreet.export.codebooks import nearest_numbers, number_book, vector_book


def drawn(rows: int, width: int, seed: int = 0) -> torch.Tensor:
    """Some clusters, and noise that is a third as wide."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.randn(40, width, generator=generator)
    return centers[torch.randint(40, (rows,), generator=generator)] + 0.3 * torch.randn(
        rows, width, generator=generator
    )


def test_numbers_are_as_near_as_other_programs_bring_them():
    values = drawn(2000, 1)[:, 0].double().numpy() ** 3
    book = number_book(values, 32)
    assert (np.diff(book) >= 0).all()
    places = nearest_numbers(values, book)
    assert np.array_equal(np.abs(values - book[places]), np.abs(values[:, None] - book).min(1))
    others, labels = kmeans2(values, np.quantile(values, (np.arange(32) + 0.5) / 32), iter=100, minit="matrix")
    ours, theirs = (values - book[places]) ** 2, (values - others[labels]) ** 2
    assert ours.mean() < 1.1 * theirs.mean()


@pytest.mark.parametrize("values", [[], [3.0], [-1.5] * 300, [0.0, 1e30]], ids=["none", "one", "equal", "far"])
def test_few_numbers_are_exact(values: list[float]):
    array = np.array(values)
    book = number_book(array, 256)
    assert book.shape == (256,)
    assert np.isfinite(book).all()
    np.testing.assert_allclose(book[nearest_numbers(array, book)], array, rtol=1e-12)


@pytest.mark.parametrize("rows", [0, 1, 63, 64])
def test_no_more_rows_than_entries_are_kept(rows: int):
    vectors = drawn(rows, 9)
    book, labels = vector_book(vectors, torch.ones(rows), 64)
    assert torch.equal(book[labels], vectors)


def test_vectors_are_as_near_as_other_programs_bring_them():
    vectors = drawn(1500, 9)
    book, labels = vector_book(vectors, torch.ones(1500), 128)
    assert len(book) <= 128
    assert labels.unique().tolist() == list(range(len(book)))
    others, places = kmeans2(vectors.numpy(), vectors[:128].numpy(), iter=10, minit="matrix", missing="raise")
    ours, theirs = (vectors - book[labels]).square().mean(), np.square(vectors.numpy() - others[places]).mean()
    # Both end where they started near: with 128 entries, starts differ by a tenth.
    assert float(ours) < 1.2 * theirs
    again, same = vector_book(vectors, torch.ones(1500), 128)
    assert torch.equal(again, book)
    assert torch.equal(same, labels)


def test_what_weighs_more_is_nearer():
    vectors, weights = drawn(2000, 9), torch.ones(2000)
    weights[::2] = 100
    book, labels = vector_book(vectors, weights, 128)
    errors = (vectors - book[labels]).square().sum(1)
    assert float(errors[::2].mean()) < 0.9 * float(errors[1::2].mean())


def test_equal_rows_leave_entries_for_the_others():
    """A sky of 12,000 discs without higher harmonics takes one entry."""
    vectors = torch.cat([torch.zeros(5000, 9), drawn(250, 9)])
    book, labels = vector_book(vectors, torch.ones(5250), 256)
    assert labels[:5000].unique().numel() == 1
    assert torch.allclose(book[labels], vectors, atol=1e-6)
