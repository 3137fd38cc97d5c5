"""``.street``: a whole trained scene in few bytes, for whoever only looks at it.

Gaussians are rounded (``codec.gaussians``), the sky to a fourth of what an image of 8 bits shows; poses, networks and
bodies are bit for bit. Files of a run that its commands need go along (``ATTACHED``), so that one file is enough.

Frames (``codec.container``): HEAD, JSON; FILE, of attached files; AXES, one for each number of harmonics; ROWS, blocks
of each table; DATA, of each other tensor.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int16, Int64
from torch import Tensor

from sparsestreet.atomic import atomic_file
from sparsestreet.codec.arrays import TYPES, Cursor, packed_column, unpacked_column
from sparsestreet.codec.container import FrameReader, FrameWriter
from sparsestreet.codec.gaussians import Block, Form, OtherColumn, Steps, packed_block, rows_in, unpacked_block
from sparsestreet.codec.vectors import curve_order, fits, packed_axes, principal_axes, unpacked_axes
from sparsestreet.scene.loaded_scene import ROWS, StoredScene, check_numbers, description, scene_of, without_masks
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
    """Return how the node's rows are packed, with principal axes by the number of harmonics."""
    size = 3 * (1 + node.rows.sh_rest.shape[1])
    others = {
        name: OtherColumn(str(column.dtype).removeprefix("torch."), tuple(column.shape[1:]), _step(node, name))
        for name, column in sorted(node.rows.columns().items())
        if name not in _STANDARD
    }
    return Form(axes[size], type(node) not in _ELLIPSOIDS, others)


def packed_blocks(node: Node, form: Form) -> Iterator[list[bytes]]:
    """Yield the node's rows, all of them finite: object by object, along a curve through each."""
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
    """Return the columns of a block, float32 as they are learned."""
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
    """Return the columns of all blocks, and empties them; those of a table without rows where there is none."""
    if not blocks:
        none = {name: np.zeros((0, *column.shape), column.dtype) for name, column in form.others.items()}
        empty = Block(
            np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0), np.zeros((0, len(form.axes))), none
        )
        return columns_of(empty, form)
    return {name: torch.cat([block.pop(name) for block in blocks]) for name in list(blocks[0])}


def second_moments(nodes: Sequence[Node]) -> dict[int, Float64[np.ndarray, "d d"]]:
    """Return the second moments of all harmonics, weighted by opacity, by the number of harmonics of a row."""
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
    """Return what a file says of a form, but for its axes."""
    others = {name: [column.dtype, list(column.shape), column.step] for name, column in form.others.items()}
    return {"harmonics": len(form.axes), "named_axes": form.named_axes, "others": others}


def form_from(header: Mapping[str, Any], axes: Mapping[int, Int16[np.ndarray, "d d"]]) -> Form:
    """Return the form that ``form_header`` described."""
    others = {
        name: OtherColumn(dtype, tuple(map(int, shape)), step)
        for name, (dtype, shape, step) in header["others"].items()
    }
    return Form(axes[header["harmonics"]], bool(header["named_axes"]), others)


def row_bytes(form: Form) -> int:
    """Return the bytes of a row once it is unpacked, before it is put into a table and after."""
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
    """Return the step of a column that only some nodes have; None: it is kept bit for bit."""
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


SUFFIX = ".street"

ATTACHED = ("views.json", "rig.json")
"""Files of a run's folder that go along where they are there. run.json does not: it names the machine that trained."""

_PIECE = 2**21
"""Numbers, or bytes of a file, in one frame."""
_SKY_STEP = 1 / 1024
_SKY = ".texels"


@torch.no_grad()
def save_street(path: Path | str, stored: StoredScene, attached: Mapping[str, bytes] | None = None) -> None:
    """Write the whole file or nothing. A scene with masks is written as they leave it, and stays as it is.

    Raises OSError where it cannot be written, TypeError for settings that are no plain values, ValueError for a scene
    whose numbers are not finite, ModuleNotFoundError without zstandard.
    """
    scene = without_masks(stored.scene)
    check_numbers(scene)
    moments = second_moments(list(scene.nodes.values()))
    axes = {size: principal_axes(found) for size, found in sorted(moments.items())}
    forms = {name: form_of(node, axes) for name, node in scene.nodes.items()}
    tensors = {name: value.detach().cpu().numpy() for name, value in scene.state_dict().items() if not _is_row(name)}
    files = dict(attached or {})
    header = {
        "scene": description(replace(stored, scene=scene)),
        "files": [[name, len(content)] for name, content in files.items()],
        "axes": list(axes),
        "tables": {name: {"rows": len(scene.nodes[name].rows), **form_header(form)} for name, form in forms.items()},
        "tensors": {name: [value.dtype.name, list(value.shape), _step_of_sky(name)] for name, value in tensors.items()},
    }
    with atomic_file(Path(path)) as temporary, temporary.open("wb") as file, FrameWriter(file) as frames:
        frames.write("HEAD", [json.dumps(header, allow_nan=False).encode()])
        for content in files.values():
            for start in range(0, len(content), _PIECE):
                frames.write("FILE", [content[start : start + _PIECE]])
        for found in axes.values():
            frames.write("AXES", [packed_axes(found)])
        for name, form in forms.items():
            for block in packed_blocks(scene.nodes[name], form):
                frames.write("ROWS", block)
        for name, value in tensors.items():
            flat = value.reshape(-1, _width(value.shape))
            for start in range(0, len(flat), _rows_of(flat.shape[1])):
                frames.write("DATA", packed_column(flat[start : start + _rows_of(flat.shape[1])], _step_of_sky(name)))


def read_street(path: Path) -> StoredScene:
    """Open a file that ``save_street`` wrote, as float32 on the host.

    Raises ValueError, naming the file, for one that is damaged, of another version, or that claims to be larger than
    its bytes allow; ModuleNotFoundError without zstandard.
    """
    with path.open("rb") as file, _naming(path):
        frames = FrameReader(file)
        header = json.loads(frames.read("HEAD"))
        for _, size in header["files"]:
            _read_file(frames, size)
        axes = {size: unpacked_axes(Cursor(frames.read("AXES")), size) for size in map(_count, header["axes"])}
        tensors = {}
        for name, table in header["tables"].items():
            columns = _read_table(frames, table, axes)
            tensors |= {f"nodes.{name}.{ROWS}{column}": value for column, value in columns.items()}
        for name, (dtype, shape, step) in header["tensors"].items():
            tensors[name] = _read_tensor(frames, dtype, tuple(map(_count, shape)), step)
        frames.finish()
        return scene_of(header["scene"], tensors)


def attached_file(path: Path, name: str) -> bytes | None:
    """The content of a file that was taken along, or None; reads no more of the file than it must.

    Raises as ``read_street``.
    """
    with path.open("rb") as file, _naming(path):
        frames = FrameReader(file)
        for found, size in json.loads(frames.read("HEAD"))["files"]:
            content = _read_file(frames, size)
            if found == name:
                return content
    return None


def _read_file(frames: FrameReader, size: int) -> bytes:
    content = b"".join(frames.read("FILE") for _ in range(0, _count(size), _PIECE))
    if len(content) != size:
        raise ValueError(f"an attached file has {len(content)} bytes, not {size}: it is damaged")
    return content


def _read_table(frames: FrameReader, table: Mapping[str, Any], axes: Mapping[int, np.ndarray]) -> dict[str, Tensor]:
    form, rows = form_from(table, axes), _count(table["rows"])
    blocks: list[dict[str, Tensor]] = []
    found = 0
    while found < rows:
        content = frames.read("ROWS")
        count = rows_in(content)
        if not 0 < count <= min(rows - found, BLOCK):
            raise ValueError(f"a block has {count} rows where {rows - found} are left: it is damaged")
        frames.budget.take(count * row_bytes(form))
        # As float32 at once: blocks are in double precision.
        blocks.append(columns_of(unpacked_block(content, form), form))
        found += count
    return joined(blocks, form)


def _read_tensor(frames: FrameReader, dtype: str, shape: tuple[int, ...], step: float | None) -> Tensor:
    if dtype not in TYPES:
        raise ValueError(f"a tensor of {dtype!r}: it is damaged")
    width = _width(shape)
    rows = math.prod(shape) // width if math.prod(shape) else 0
    frames.budget.take(16 * rows * width)
    parts = []
    for start in range(0, rows, _rows_of(width)):
        cursor = Cursor(frames.read("DATA"))
        parts.append(unpacked_column(cursor, min(_rows_of(width), rows - start), (width,), dtype, step))
        cursor.finish()
    whole = np.concatenate(parts) if parts else np.zeros(0, dtype)
    return torch.from_numpy(whole.reshape(shape))


def _is_row(name: str) -> bool:
    return name.startswith("nodes.") and name.split(".", 2)[2].startswith(ROWS)


def _step_of_sky(name: str) -> float | None:
    return _SKY_STEP if name.startswith("effects.") and name.endswith(_SKY) else None


def _width(shape: tuple[int, ...]) -> int:
    """Numbers in an entry of a tensor's last axis, which are packed as columns."""
    return max(shape[-1], 1) if len(shape) > 1 else 1


def _rows_of(width: int) -> int:
    return max(_PIECE // width, 1)


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**48:
        raise ValueError(f"{value!r} is no number of rows, bytes or axes: it is damaged")
    return value


@contextmanager
def _naming(path: Path):
    """Turn whatever a damaged file causes into one sentence with its name."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path} is no .street or is damaged: {' '.join(str(error).split())}") from error
    except (KeyError, TypeError, AttributeError, RuntimeError, OverflowError, MemoryError, RecursionError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{path} is no .street or is damaged ({reason}): export it again") from error
