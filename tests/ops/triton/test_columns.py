"""Rows of many numbers through the tiles that lanes read and write together."""

import pytest
import torch
import triton.language as tl

from sparsestreet.ops.triton.launch import jit, launch
from sparsestreet.ops.triton.view import load_columns, store_columns
from tests.ops.scenes import device_of

DEVICE = device_of("triton")


@jit
def copy_reversed(table, to, wanted, rows, COUNT: tl.constexpr, BLOCK: tl.constexpr):
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given = row < rows
    asked = tl.load(wanted + row, given, 0) > 0
    columns, turned = load_columns(table, row, asked, COUNT), ()  # pyright: ignore[reportCallIssue]
    for i in tl.static_range(COUNT):  # pyright: ignore[reportGeneralTypeIssues]
        turned += (columns[COUNT - 1 - i],)
    store_columns(to, row, turned, given, COUNT)  # pyright: ignore[reportCallIssue]


@pytest.mark.parametrize("count", [3, 4, 12, 27, 48])
def test_columns_come_and_go_in_order(count):
    # Two programs, the second one partial; rows that are not wanted hold NaN and come as 0.
    table = torch.arange(40.0 * count, device=DEVICE).reshape(40, count)
    wanted = torch.arange(40, dtype=torch.int32, device=DEVICE) % 3
    expected = torch.where(wanted[:, None] > 0, table, 0.0).flip(1)
    table[wanted == 0] = float("nan")
    to = torch.full((48, count), -1.0, device=DEVICE)
    launch(copy_reversed, 40, 32, table, to, wanted, 40, COUNT=count)
    assert torch.equal(to[:40], expected)
    assert (to[40:] == -1).all()
