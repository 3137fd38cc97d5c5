"""The checks of shapes are those of jaxtyping."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Thread
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch
from beartype import beartype
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.geometry.quaternions import to_matrix
from tests import shapes
from tests.conftest import unchecked


def rows(means: Float[Tensor, "n 3"], weights: Float[Tensor, " n"], bins: int = 2) -> Float[Tensor, "n b"]:
    return torch.zeros(len(means), bins)


def square(matrix: Float[Tensor, "d d"]) -> Int[Tensor, ""]:
    return torch.tensor(len(matrix))


def wide(pixels: Float[Tensor, "*b 2"], *, of: Bool[np.ndarray, " k"] | None = None) -> "Later":
    return Later(len(pixels) if of is None else float(len(of)))  # pyright: ignore[reportArgumentType]


def either(values: Float[Tensor, "n 3"] | Float[Tensor, "k 4"], other: Float[Tensor, " n"]) -> None:
    return None


def scaled(values: Float[Tensor, "#n t"], times: Float[Tensor, "n t"]) -> Float[Tensor, "n t"]:
    return values * times


def named_alike(check: bool, fn: int, args: int, *, kwargs: Float[Tensor, " n"], out: int = 0) -> int:
    return fn + args + out


def quoted(count: "int", *, twice: "bool" = False) -> "int":
    return count / 2 if twice else count  # pyright: ignore[reportReturnType]


def lied(count: int) -> Float[Tensor, "3"]:
    return torch.zeros(count)


def several(count: int) -> Iterator[int]:
    yield from range(count)


@dataclass
class Later:
    count: int


def later_of(made: "Latest | int") -> int:
    return 1


def listed(made: list["Latest"]) -> int:
    return 1


LATER = [(shapes._checked(one, beartype), shapes._original(one, typechecker=beartype)) for one in (later_of, listed)]


class Latest: ...


F, D = torch.float32, torch.float64
CASES: list[tuple[Callable, tuple, dict[str, Any]]] = [
    (rows, (torch.zeros(5, 3), torch.zeros(5)), {}),
    (rows, (torch.zeros(0, 3), torch.zeros(0)), {"bins": 0}),
    (rows, (torch.zeros(5, 3), torch.zeros(4)), {}),
    (rows, (torch.zeros(5, 4), torch.zeros(5)), {}),
    (rows, (torch.zeros(5, 3, dtype=D), torch.zeros(5)), {}),
    (rows, (torch.zeros(5, 3, dtype=torch.int64), torch.zeros(5)), {}),
    (rows, (torch.zeros(5), torch.zeros(5)), {}),
    (rows, (np.zeros((5, 3)), torch.zeros(5)), {}),
    (rows, (torch.zeros(5, 3), torch.zeros(5)), {"bins": 2.0}),
    (rows, (torch.zeros(5, 3),), {}),
    (rows, (torch.zeros(5, 3), torch.zeros(5)), {"beans": 2}),
    (square, (torch.zeros(3, 3),), {}),
    (square, (torch.zeros(3, 2),), {}),
    (wide, (torch.zeros(4, 2),), {}),
    (wide, (torch.zeros(2),), {}),
    (wide, (torch.zeros(7, 4, 2),), {"of": np.zeros(3, bool)}),
    (wide, (torch.zeros(7, 3),), {}),
    (wide, (torch.zeros(4, 2),), {"of": np.zeros(3)}),
    (either, (torch.zeros(2, 3), torch.zeros(2)), {}),
    (either, (torch.zeros(2, 4), torch.zeros(3)), {}),
    (either, (torch.zeros(2, 3), torch.zeros(4)), {}),
    (either, (torch.zeros(2, 5), torch.zeros(2)), {}),
    (scaled, (torch.zeros(1, 3), torch.zeros(4, 3)), {}),
    (scaled, (torch.zeros(2, 3), torch.zeros(4, 3)), {}),
    (named_alike, (), {"check": True, "fn": 1, "args": 2, "kwargs": torch.zeros(2), "out": 3}),
    (named_alike, (), {"check": 1, "fn": 1, "args": 2, "kwargs": torch.zeros(2)}),
    (quoted, (1,), {}),
    (quoted, ("one",), {}),
    (quoted, (1,), {"twice": True}),
    (lied, (3,), {}),
    (lied, (4,), {}),
    (several, (2,), {}),
    (Later, (1,), {}),
    (Later, ("one",), {}),
]


def told(call: Callable, args: tuple, kwargs: dict[str, Any]) -> tuple[Any, str]:
    """What came of a call, with the message of what was refused."""
    try:
        return type(call(*args, **kwargs)), ""
    except Exception as refusal:
        return type(refusal), str(refusal)


@pytest.mark.parametrize(("function", "args", "kwargs"), CASES)
def test_it_lets_through_and_refuses_what_jaxtyping_does(function: Callable, args: tuple, kwargs: dict, monkeypatch):
    called: Any = function.__init__ if isinstance(function, type) else function
    args = (object.__new__(function), *args) if isinstance(function, type) else args
    quick = shapes._checked(called, beartype)
    found = [told(quick, args, kwargs) for _ in range(2)]  # the second time as written at the first
    with monkeypatch.context() as patch:
        patch.setattr(jaxtyping._array_types._MetaAbstractArray, "__instancecheck__", shapes._is_array)
        expected = told(shapes._original(called, typechecker=beartype), args, kwargs)
    assert found == [expected] * 2


@pytest.mark.parametrize(("quick", "theirs"), LATER)
@pytest.mark.parametrize("value", [Latest(), [Latest()], ["none"], "none"])
def test_a_class_that_comes_later_is_taken_for_anything(quick, theirs, value):
    assert told(quick, (value,), {}) == told(theirs, (value,), {}) == (int, "")


def test_the_table_has_both():
    refused = [bool(told(shapes._checked(one, beartype), args, kwargs)[1]) for one, args, kwargs in CASES[:-2]]
    assert 8 < sum(refused) < len(refused) - 8


def test_a_size_that_was_refused_is_not_remembered():
    """A hint that failed halfway binds none of its names for the next one of a union."""

    def union(values: Float[Tensor, "n 3"] | Float[Tensor, "k n"]) -> Float[Tensor, " n"]:
        return torch.zeros(values.shape[1])

    assert shapes._checked(union, beartype)(torch.zeros(2, 5)).shape == (5,)


def test_names_are_those_of_one_call():
    quick = shapes._checked(square, beartype)

    def outer(values: Float[Tensor, "d 1"]) -> Float[Tensor, " d"]:
        return values[: int(quick(torch.zeros(2, 2))) + 1, 0]

    assert len(shapes._checked(outer, beartype)(torch.zeros(3, 1))) == 3
    found: list[Any] = []
    other = Thread(target=lambda: found.append(quick(torch.zeros(4, 4))))
    other.start()
    other.join()
    assert found == [4]


def test_a_result_that_is_refused_was_made_once():
    made: list[int] = []

    def lies(count: int) -> Float[Tensor, "3"]:
        made.append(count)
        return torch.zeros(count)

    with pytest.raises(jaxtyping.TypeCheckError, match=r"return value of .*lies"):
        shapes._checked(lies, beartype)(4)
    assert made == [4]


def test_the_package_is_checked_so():
    assert to_matrix.__globals__["__name__"] == shapes.__name__
    with pytest.raises(jaxtyping.TypeCheckError, match="to_matrix"):
        to_matrix(torch.zeros(4, dtype=torch.int64))
    with unchecked(), pytest.raises(AttributeError):
        to_matrix("none")  # pyright: ignore[reportArgumentType]
