"""The check names the field, the row and the value, whatever the shape and whichever rows are read."""

import pytest
import torch

from sparsestreet.finite import check_finite


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_names_field_row_and_value(value: float) -> None:
    fields = {"means": torch.zeros(5, 3), "sh": torch.zeros(5, 4, 3, dtype=torch.float64)}
    fields["sh"][3, 2, 1] = value
    with pytest.raises(ValueError, match=rf"sh must be finite, but point 3 has {value}: leave it out"):
        check_finite(fields, "leave it out", row="point")


def test_rows_that_nobody_reads_hold_anything() -> None:
    values = torch.tensor([float("nan"), 1.0, float("nan")])
    check_finite({"scales": values[:2]}, "-", unread=torch.tensor([True, False]))
    with pytest.raises(ValueError, match="row 2 has nan"):
        check_finite({"scales": values}, "-", unread=torch.tensor([True, False, False]))


def test_nothing_is_finite() -> None:
    check_finite({"means": torch.zeros(0, 3)}, "-")
