"""Writes the machine code of every variant of the pixel kernels down, in numbers: benchmarks/pixel_kernels.jsonl.

Nothing runs on a device: kernels are launched in the interpreter, and compiled for three architectures. With the
argument "gates" those of training whose rows have gates: benchmarks/pixel_kernels_gates.jsonl.

    TRITON_INTERPRET=1 python -m tests.ops.triton.pixel_machine_code [gates]
"""

import dataclasses
import itertools
import json
import sys
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


STOPS = [SplatSettings(stop="inclusive"), SplatSettings(stop="exclusive")]
# Split tiles in two launches and in four, and tiles that are not split.
SPLITS = [{"shortest_part": 1}, {"shortest_part": 1, "two_launches": False}, {"shortest_part": 1000}]
OTHERS = [{}, {"staged": False, "marked_slots": True}]


def variants(gated: bool) -> list[Launch]:
    """Each choice of each kernel: with either stop, before a backward pass and not, with depth and not.

    Of rows that have gates the defaults of all other choices, before a backward pass."""
    view, scene = camera(5, 4), random_gaussians(3, camera(5, 4), terms=1)
    splits, others = (SPLITS[::2], OTHERS[:1]) if gated else (SPLITS, OTHERS)
    gates = torch.ones(3) if gated else None
    with pytest.MonkeyPatch.context() as monkeypatch:
        launches = record_launches(monkeypatch)
        for settings, split, other in itertools.product(STOPS, splits, others):
            with tuned(Tuning(**split, **other)):
                for output in ("rgb", "depth"):
                    leaves = cast(scene, torch.float32, requires_grad=True)
                    drawn = splat(leaves, view, backend="triton", settings=settings, gates=gates)
                    getattr(drawn, output).sum().backward()
                if not gated:
                    splat(cast(scene, torch.float32), view, backend="triton", settings=settings)
    unique = {json.dumps(dataclasses.asdict(item), sort_keys=True): item for item in launches if item.name in KERNELS}
    return sorted(unique.values(), key=lambda item: (KERNELS.index(item.name), _switches(item)))


def _switches(launch: Launch) -> str:
    return " ".join(sorted(name for name, value in launch.constants.items() if value is True))


def main(*wanted: str) -> None:
    """Writes one line for each kernel and architecture; ``wanted``: nothing or "gates"."""
    path, command = Path("benchmarks") / "_".join(("pixel_kernels", *wanted)), " ".join((COMMAND, *wanted))
    file = RecordFile(path.with_suffix(".jsonl"), Provenance(command, 1, this_machine(), this_source()))
    launches = variants(gated="gates" in wanted)
    for architecture in ARCHITECTURES:
        for launch, found in compile_launches(launches, architecture):
            code = KernelCode(
                triton.__version__, f"sm_{architecture}", launch.name, _switches(launch),
                found["registers"], found["spilled"], found["loops"],
            )  # fmt: skip
            file.write("kernel", code)


if __name__ == "__main__":
    main(*sys.argv[1:])
