"""The rows of a node as blocks for the codec, and back."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int16, Int64
from torch import Tensor

from sparsestreet.codec.gaussians import Block, Form, OtherColumn, Steps, packed_block
from sparsestreet.codec.vectors import curve_order, fits
from sparsestreet.scene.nodes import Background, Node, Rigid, Smpl, Vibrating

BLOCK = 65_536
"""Rows that are packed and unpacked at a time: what bounds memory beside the scene's own."""

_POSITION_SHARE = 1 / 48
"""Step of positions, in lower quartiles of the middle axis of a block's Gaussians."""
_FLOAT32 = 2.0**-24
"""Relative precision of float32: finer steps than this would keep its rounding."""
_LIFE_SHARE = 1 / 64
"""Step of life peaks, in lower quartiles of life spans."""

_STANDARD = ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest")
_ELLIPSOIDS = (Background, Rigid, Smpl, Vibrating)
"""Nodes in which an axis of a Gaussian has no name of its own: nothing is added to quaternions or scales."""


def form_of(node: Node, axes: Mapping[int, Int16[np.ndarray, "d d"]]) -> Form:
    """Returns how the node's rows are packed, with principal axes by the number of harmonics."""
    size = 3 * (1 + node.rows.sh_rest.shape[1])
    others = {
        name: OtherColumn(str(column.dtype).removeprefix("torch."), tuple(column.shape[1:]), _step(node, name))
        for name, column in sorted(node.rows.columns().items())
        if name not in _STANDARD
    }
    return Form(axes[size], type(node) not in _ELLIPSOIDS, others)


def packed_blocks(node: Node, form: Form) -> Iterator[list[bytes]]:
    """Yields the node's rows, all of them finite: object by object, along a curve through each."""
    columns = {name: column.detach().cpu() for name, column in node.rows.columns().items()}
    means = columns["means"].double().numpy()
    order = curve_order(means)
    if "instances" in columns:
        order = order[np.argsort(columns["instances"].numpy()[order], kind="stable")]
    waiting = [order[start : start + BLOCK] for start in range(0, len(order), BLOCK)][::-1]
    while waiting:
        rows = waiting.pop()
        step = _position_step(columns, rows)
        if fits(means[rows], step):
            yield packed_block(_block(columns, rows, form), form, Steps(step))
        else:
            waiting += [rows[len(rows) // 2 :], rows[: len(rows) // 2]]


def columns_of(block: Block, form: Form) -> dict[str, Tensor]:
    """Returns the columns of a block, float32 as they are learned."""
    colors = torch.from_numpy(block.harmonics).float().reshape(len(block), len(form.axes) // 3, 3)
    return {
        "means": torch.from_numpy(block.means).float(),
        "log_scales": torch.from_numpy(block.log_scales).float(),
        "quaternions": torch.from_numpy(block.quaternions).float(),
        "opacity_logits": torch.from_numpy(block.opacity_logits).float(),
        "sh_dc": colors[:, :1].contiguous(),
        "sh_rest": colors[:, 1:].contiguous(),
        **{name: torch.from_numpy(np.array(block.others[name])) for name in form.others},
    }


def joined(blocks: list[dict[str, Tensor]], form: Form) -> dict[str, Tensor]:
    """Returns the columns of all blocks, and empties them; those of a table without rows where there is none."""
    if not blocks:
        none = {name: np.zeros((0, *column.shape), column.dtype) for name, column in form.others.items()}
        empty = Block(
            np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0), np.zeros((0, len(form.axes))), none
        )
        return columns_of(empty, form)
    return {name: torch.cat([block.pop(name) for block in blocks]) for name in list(blocks[0])}


def second_moments(nodes: Sequence[Node]) -> dict[int, Float64[np.ndarray, "d d"]]:
    """Returns the second moments of all harmonics, weighted by opacity, by the number of harmonics of a row."""
    sums: dict[int, Float64[np.ndarray, "d d"]] = {}
    for node in nodes:
        size = 3 * (1 + node.rows.sh_rest.shape[1])
        total = sums.setdefault(size, np.zeros((size, size)))
        for start in range(0, len(node.rows), BLOCK):
            rows = slice(start, start + BLOCK)
            colors = torch.cat([node.rows.sh_dc[rows], node.rows.sh_rest[rows]], dim=1).detach().double()
            weights = torch.sigmoid(node.rows.opacity_logits[rows].detach().double())
            flat = colors.flatten(1)
            total += ((flat * weights[:, None]).T @ flat).cpu().numpy()
    return sums


def form_header(form: Form) -> dict[str, Any]:
    """Returns what a file says of a form, but for its axes."""
    others = {name: [column.dtype, list(column.shape), column.step] for name, column in form.others.items()}
    return {"harmonics": len(form.axes), "named_axes": form.named_axes, "others": others}


def form_from(header: Mapping[str, Any], axes: Mapping[int, Int16[np.ndarray, "d d"]]) -> Form:
    """Returns the form that ``form_header`` described."""
    others = {
        name: OtherColumn(dtype, tuple(map(int, shape)), step)
        for name, (dtype, shape, step) in header["others"].items()
    }
    return Form(axes[header["harmonics"]], bool(header["named_axes"]), others)


def row_bytes(form: Form) -> int:
    """Returns the bytes of a row once it is unpacked, before it is put into a table and after."""
    return 16 * (11 + len(form.axes)) + sum(16 * math.prod(column.shape) for column in form.others.values())


def _block(columns: Mapping[str, Tensor], rows: Int64[np.ndarray, " n"], form: Form) -> Block:
    chosen = {name: column[torch.from_numpy(rows)] for name, column in columns.items()}
    colors = torch.cat([chosen["sh_dc"], chosen["sh_rest"]], dim=1).flatten(1)
    means, log_scales, quaternions, logits = (chosen[name].double().numpy() for name in _STANDARD[:4])
    others = {name: chosen[name].numpy() for name in form.others}
    return Block(means, log_scales, quaternions, logits, colors.double().numpy(), others)


def _position_step(columns: Mapping[str, Tensor], rows: Int64[np.ndarray, " n"]) -> float:
    chosen = torch.from_numpy(rows)
    middle = columns["log_scales"][chosen].double().sort(1).values[:, 1].numpy()
    largest = float(columns["means"][chosen].abs().max()) if len(rows) else 0.0
    # A log scale beyond this belongs to no street, and its exponential is no number.
    size = math.exp(min(float(np.quantile(middle, 0.25)), 50.0)) if len(rows) else 1.0
    return max(_POSITION_SHARE * size, _FLOAT32 * largest, 1e-30)


def _step(node: Node, name: str) -> float | None:
    """Returns the step of a column that only some nodes have; None: it is kept bit for bit."""
    if not isinstance(node, Vibrating) or not len(node.rows):
        return None
    if name == "velocities":
        # The way from a life peak is at most velocity times cycle / 2 pi.
        middle = node.rows.log_scales.detach().double().sort(1).values[:, 1].numpy()
        return _POSITION_SHARE * math.exp(float(np.quantile(middle, 0.25))) * 2 * math.pi / node.settings.cycle
    spans = node.rows.log_life_spans.detach().double().numpy()
    if name == "life_peaks":
        return _LIFE_SHARE * math.exp(float(np.quantile(spans, 0.25)))
    return Steps.log_scale if name == "log_life_spans" else None
