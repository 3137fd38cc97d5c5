"""Statistics of rows: all backends against a loop over the rows in float64."""

import math

import pytest
import torch
from torch import Tensor

from sparsestreet.ops.backend import has_triton
from sparsestreet.ops.statistics import add_view_
from tests.ops.scenes import device_of

BACKENDS = ["torch", "cpu"] + ["triton"] * has_triton()
every_backend = pytest.mark.parametrize("backend", BACKENDS)
SIZE = (30, 17)


def view(rows: int, columns: int, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """A gradient on screen, radii, and gradients of columns: rows that were not drawn, that are not finite in one of
    them, whose squares are beyond float32, and whose norm is."""
    generator = torch.Generator().manual_seed(rows)
    gradient = torch.randn(rows, 2, generator=generator) * 10 ** (-6 * torch.rand(rows, 1, generator=generator))
    radii = (40 * torch.rand(rows, generator=generator) - 10).clamp(min=0)
    watched = list(torch.randn(columns, rows, generator=generator))
    if rows > 9:
        gradient[2, 0], gradient[3, 1], gradient[4, 1] = torch.nan, torch.inf, -torch.inf
        gradient[5], gradient[6], gradient[7] = 1e30, torch.tensor([-3e38, 0.0]), torch.nan
        radii[2:7], radii[7], radii[8] = 3.0, 0.0, 5.0
        for column in watched:
            column[8], column[9] = torch.nan, -torch.inf
    return [one.to(dtype) for one in (gradient, radii, *watched)]


def statistics(rows: int, columns: int, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """Sums, visits, largest radii and sums of columns, of some views before."""
    sums = [torch.linspace(0, 2 + place, rows, dtype=dtype) for place in range(2 + columns)]
    return [sums[0], torch.arange(rows) % 4, *sums[1:]]


def added(before: list[Tensor], seen: list[Tensor], visits_all: bool) -> list[list[float]]:
    """By the definition, row by row."""
    rows = [[float(values[row]) for values in before] for row in range(len(before[0]))]
    for row, (found, (x, y)) in enumerate(zip(rows, seen[0].tolist(), strict=True)):
        radius = float(seen[1][row])
        half = [torch.tensor(value, dtype=seen[0].dtype) * side / 2 for value, side in zip((x, y), SIZE, strict=True)]
        norm = torch.tensor(math.hypot(*map(float, half)), dtype=seen[0].dtype).item()
        drawn = radius > 0 and math.isfinite(norm)
        found[0] += norm if drawn else 0.0
        found[1] += drawn or visits_all
        found[2] = max(found[2], radius / max(SIZE))
        for place, column in enumerate(seen[2:], 3):
            found[place] += abs(float(column[row])) if drawn and math.isfinite(column[row]) else 0.0
    return rows


def add(into: list[Tensor], seen: list[Tensor], visits_all: bool, backend: str) -> None:
    watched = list(zip(into[3:], seen[2:], strict=True))
    sums, visits, largest = into[:3]
    add_view_(sums, visits, largest, seen[0], seen[1], SIZE, visits_all=visits_all, watched=watched, backend=backend)


@every_backend
@pytest.mark.parametrize(
    ("rows", "columns", "visits_all"), [(300, 0, False), (131, 1, True), (10, 2, False), (1, 0, True)]
)
def test_a_view_is_added_as_defined(rows, columns, visits_all, backend):
    into, seen = statistics(rows, columns), view(rows, columns)
    wanted = added(into, seen, visits_all)
    moved = [[one.to(device_of(backend)) for one in some] for some in (into, seen)]
    add(moved[0], moved[1], visits_all, backend)
    found = [one.cpu() for one in moved[0]]
    assert found[1].tolist() == [row[1] for row in wanted]
    for place, values in enumerate(found):
        # A norm, a share and a sum are each rounded once.
        truth = torch.tensor([row[place] for row in wanted], dtype=torch.float64)
        torch.testing.assert_close(values.double(), truth, rtol=2.5e-7, atol=0)


def test_the_library_and_triton_have_the_same_bits_and_double_its_digits():
    found = []
    for backend, dtype in (("cpu", torch.float32), ("triton", torch.float32), ("cpu", torch.float64)):
        if backend == "triton" and not has_triton():
            continue
        into, seen = statistics(300, 1, dtype), view(300, 1, dtype)
        into, seen = ([one.to(device_of(backend)) for one in some] for some in (into, seen))
        add(into, seen, False, backend)
        found.append([one.cpu() for one in into])
    *single, double = found
    assert all(map(torch.equal, single[0], single[-1]))
    finite = double[0] < 3e38  # a norm beyond float32 is one of a row in double
    for one, other in zip(single[0], double, strict=True):
        torch.testing.assert_close(one.double()[finite], other.double()[finite], rtol=2.5e-7, atol=0)
    reference = statistics(300, 1, torch.float64)
    add(reference, view(300, 1, torch.float64), False, "torch")
    for one, other in zip(double, reference, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-15, atol=0)


@every_backend
def test_views_of_tables_and_none_at_all(backend):
    device = device_of(backend)
    into, seen = statistics(12, 0), view(12, 0)
    into, seen = ([one.to(device) for one in some] for some in (into, seen))
    other = [one.clone() for one in into]
    add(into, seen, False, backend)
    add(other, [seen[0].T.contiguous().T, seen[1].repeat_interleave(2)[::2]], False, backend)
    assert all(map(torch.equal, into, other))
    add([one[:0] for one in into], [one[:0] for one in seen], False, backend)
    assert all(map(torch.equal, into, other))
