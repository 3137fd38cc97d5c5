"""``.street``: a whole trained scene in few bytes, for whoever only looks at it.

Gaussians are rounded (``codec.gaussians``), the sky to a fourth of what an image of 8 bits shows; poses, networks and
bodies are bit for bit. Files of a run that its commands need go along (``ATTACHED``), so that one file is enough.

Frames (``codec.container``): HEAD, JSON; FILE, of attached files; AXES, one for each number of harmonics; ROWS, blocks
of each table; DATA, of each other tensor.
"""

import json
import math
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sparsestreet.atomic import atomic_file
from sparsestreet.codec.arrays import TYPES, Cursor, packed_column, unpacked_column
from sparsestreet.codec.container import FrameReader, FrameWriter
from sparsestreet.codec.gaussians import rows_in, unpacked_block
from sparsestreet.codec.vectors import packed_axes, principal_axes, unpacked_axes
from sparsestreet.scene import packing
from sparsestreet.scene.stored import ROWS, StoredScene, check_numbers, description, scene_of, without_masks

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
    moments = packing.second_moments(list(scene.nodes.values()))
    axes = {size: principal_axes(found) for size, found in sorted(moments.items())}
    forms = {name: packing.form_of(node, axes) for name, node in scene.nodes.items()}
    tensors = {name: value.detach().cpu().numpy() for name, value in scene.state_dict().items() if not _is_row(name)}
    files = dict(attached or {})
    header = {
        "scene": description(replace(stored, scene=scene)),
        "files": [[name, len(content)] for name, content in files.items()],
        "axes": list(axes),
        "tables": {
            name: {"rows": len(scene.nodes[name].rows), **packing.form_header(form)} for name, form in forms.items()
        },
        "tensors": {name: [value.dtype.name, list(value.shape), _step(name)] for name, value in tensors.items()},
    }
    with atomic_file(Path(path)) as temporary, temporary.open("wb") as file, FrameWriter(file) as frames:
        frames.write("HEAD", [json.dumps(header, allow_nan=False).encode()])
        for content in files.values():
            for start in range(0, len(content), _PIECE):
                frames.write("FILE", [content[start : start + _PIECE]])
        for found in axes.values():
            frames.write("AXES", [packed_axes(found)])
        for name, form in forms.items():
            for block in packing.packed_blocks(scene.nodes[name], form):
                frames.write("ROWS", block)
        for name, value in tensors.items():
            flat = value.reshape(-1, _width(value.shape))
            for start in range(0, len(flat), _rows_of(flat.shape[1])):
                frames.write("DATA", packed_column(flat[start : start + _rows_of(flat.shape[1])], _step(name)))


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
    form, rows = packing.form_from(table, axes), _count(table["rows"])
    blocks: list[dict[str, Tensor]] = []
    found = 0
    while found < rows:
        content = frames.read("ROWS")
        count = rows_in(content)
        if not 0 < count <= min(rows - found, packing.BLOCK):
            raise ValueError(f"a block has {count} rows where {rows - found} are left: it is damaged")
        frames.budget.take(count * packing.row_bytes(form))
        # As float32 at once: blocks are in double precision.
        blocks.append(packing.columns_of(unpacked_block(content, form), form))
        found += count
    return packing.joined(blocks, form)


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


def _step(name: str) -> float | None:
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
    """Turns whatever a damaged file causes into one sentence with its name."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path} is no .street or is damaged: {' '.join(str(error).split())}") from error
    except (KeyError, TypeError, AttributeError, RuntimeError, OverflowError, MemoryError, RecursionError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{path} is no .street or is damaged ({reason}): export it again") from error
