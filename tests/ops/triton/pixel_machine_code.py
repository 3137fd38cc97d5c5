"""Writes the machine code of every variant of the pixel kernels down, in numbers: benchmarks/pixel_kernels.jsonl.

Nothing runs on a device: kernels are launched in the interpreter, and compiled for three architectures.

    TRITON_INTERPRET=1 python -m tests.ops.triton.pixel_machine_code
"""

import dataclasses
import itertools
import json
from pathlib import Path

import pytest
import torch
import triton

from sparsestreet.bench.records import Provenance, RecordFile
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.triton.tuning import Tuning, tuned
from sparsestreet.records.provenance import this_machine, this_source
from tests.ops.scenes import camera, cast, random_gaussians
from tests.ops.triton.recording import Launch, compile_launches, record_launches

ARCHITECTURES = (80, 90, 120)
KERNELS = ("blend_tiles", "thin_parts", "compose_pixels", "blend_tiles_backward", "sum_slots")
RECORD = Path("benchmarks") / "pixel_kernels.jsonl"
COMMAND = "TRITON_INTERPRET=1 python -m tests.ops.triton.pixel_machine_code"


@dataclasses.dataclass(frozen=True)
class KernelCode:
    """One kernel on one architecture."""

    triton: str
    architecture: str
    kernel: str
    switches: str
    registers: int
    stack_bytes: int
    loops: list[dict[str, int]]
    """Innermost loops around powers of two, the blend last: instructions of a pair that touches all quadrants, loads
    from memory, exchanges between lanes, accesses to spilled registers."""


def variants() -> list[Launch]:
    """Each choice of each kernel: with either stop, before a backward pass and not, with depth and not."""
    view, scene = camera(5, 4), random_gaussians(3, camera(5, 4), terms=1)
    stops = [SplatSettings(stop="inclusive"), SplatSettings(stop="exclusive")]
    # Split tiles in two launches and in four, and tiles that are not split.
    splits = [{"shortest_part": 1}, {"shortest_part": 1, "two_launches": False}, {"shortest_part": 1000}]
    others = [{}, {"staged_tiles": 1, "marked_slots": True}]
    with pytest.MonkeyPatch.context() as monkeypatch:
        launches = record_launches(monkeypatch)
        for settings, split, other in itertools.product(stops, splits, others):
            with tuned(Tuning(**split, **other)):
                for output in ("rgb", "depth"):
                    leaves = cast(scene, torch.float32, requires_grad=True)
                    getattr(splat(leaves, view, backend="triton", settings=settings), output).sum().backward()
                splat(cast(scene, torch.float32), view, backend="triton", settings=settings)
    unique = {json.dumps(dataclasses.asdict(item), sort_keys=True): item for item in launches if item.name in KERNELS}
    return sorted(unique.values(), key=lambda item: (KERNELS.index(item.name), _switches(item)))


def _switches(launch: Launch) -> str:
    return " ".join(sorted(name for name, value in launch.constants.items() if value is True))


def main() -> None:
    """Writes one line for each kernel and architecture."""
    file = RecordFile(RECORD, Provenance(COMMAND, 1, this_machine(), this_source()))
    launches = variants()
    for architecture in ARCHITECTURES:
        for launch, found in compile_launches(launches, architecture):
            code = KernelCode(
                triton.__version__, f"sm_{architecture}", launch.name, _switches(launch),
                found["registers"], found["spilled"], found["loops"],
            )  # fmt: skip
            file.write("kernel", code)


if __name__ == "__main__":
    main()
