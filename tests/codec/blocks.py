"""Gaussians for the tests of the codec."""

import numpy as np

from sparsestreet.codec.gaussians import Block, Form, OtherColumn
from sparsestreet.codec.vectors import principal_axes

OTHERS = {
    "instances": OtherColumn("int64", ()),
    "bits": OtherColumn("uint8", (3,)),
    "odd": OtherColumn("float32", (2,)),
}


def block(rows: int, *, terms: int = 4, seed: int = 0) -> Block:
    """Rows in a box of 20 m, with the number of the row in one of their columns."""
    random = np.random.default_rng(seed)
    return Block(
        random.uniform(-10, 10, (rows, 3)) * [1, 1, 0.1],
        random.normal(-2, 1, (rows, 3)),
        random.normal(0, 1, (rows, 4)),
        random.normal(0, 3, rows),
        random.normal(0, 0.3, (rows, 3 * terms)) / (1 + np.arange(3 * terms)),
        {
            "instances": np.arange(rows),
            "bits": random.integers(0, 256, (rows, 3)).astype(np.uint8),
            "odd": random.normal(0, 1, (rows, 2)).astype(np.float32),
        },
    )


def form(one: Block, *, named_axes: bool = False) -> Form:
    return Form(principal_axes(one.harmonics.T @ one.harmonics), named_axes, OTHERS)
