"""Compiles kernels for GPUs that need not be there, and counts what the machine code holds.

Run as a script, without TRITON_INTERPRET: launches (recorded by test_machine_code.py) come in as JSON on standard
input, what was compiled of them goes out as JSON.
"""

import hashlib
import importlib
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import triton
import triton.language as tl
from triton import knobs
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.runtime.jit import JITFunction

_TOOLS = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"


def compile_launch(launch: dict, arch: int) -> dict:
    """Registers, spills, instructions per sample and tensor-core instructions of one launch on one architecture.

    It is compiled while the functions ``without`` are missing from the kernel's module.
    """
    module = importlib.import_module(launch["module"])
    missing = {name: getattr(module, name) for name in launch.get("without", ())}
    for name in missing:
        delattr(module, name)
    knobs.compilation.always_compile = bool(missing)
    try:
        return _compile(getattr(module, launch["name"]), launch, arch)
    finally:
        vars(module).update(missing)


def _compile(kernel: JITFunction, launch: dict, arch: int) -> dict:
    constants = {name: _constant(value) for name, value in launch["constants"].items()}
    types = {**launch["types"], **dict.fromkeys(constants, "constexpr")}
    signature = {name: types[name] for name in kernel.arg_names}
    # Tensors begin at multiples of 16 bytes; whole numbers are taken as arbitrary, which costs most.
    attributes = {
        (i,): [["tt.divisibility", 16]] for i, name in enumerate(kernel.arg_names) if types[name].startswith("*")
    }
    compiled = triton.compile(
        ASTSource(kernel, signature, constants, attributes), GPUTarget("cuda", arch, 32), options=launch["options"]
    )
    cubin = compiled.asm["cubin"]
    instructions = _instructions_of(cubin)
    return {
        **resources_of(cubin),
        "tensor_core": _tensor_core(instructions) + compiled.asm["ptx"].count("tf32"),
        "atomics": _atomics(instructions),
        "sample": _per_sample(instructions),
        "loads": sum(text.startswith("LDG") for _, text in instructions),
        "stores": sum(text.startswith("STG") for _, text in instructions),
        "tiles": _tiles(compiled.asm["ttgir"]),
        "code": hashlib.sha256(repr(instructions).encode()).hexdigest(),
    }


def _constant(value: object) -> object:
    return tl.dtype(value["dtype"]) if isinstance(value, dict) else value


def resources_of(cubin: bytes) -> dict[str, int]:
    """Registers, and bytes of stack, where spilled registers go."""
    used = re.search(r"REG:(\d+) STACK:(\d+)", _listed(cubin, "-res-usage"))
    return {"registers": int(used[1]), "spilled": int(used[2])}


def forbidden_in(cubin: bytes) -> dict[str, int]:
    """Instructions of the tensor cores, and atomics."""
    instructions = _instructions_of(cubin)
    return {"tensor_core": _tensor_core(instructions), "atomics": _atomics(instructions)}


def _tensor_core(instructions: list[tuple[int, str]]) -> int:
    return sum(bool(re.match(r"[A-Z]*MMA", text)) for _, text in instructions)


def _atomics(instructions: list[tuple[int, str]]) -> int:
    return sum(text.split()[0].startswith(("ATOM", "RED.", "REDG.")) for _, text in instructions)


def _instructions_of(cubin: bytes) -> list[tuple[int, str]]:
    """Instructions with their addresses."""
    pattern = r"^\s*/\*([0-9a-f]{4,})\*/\s+(?:@!?U?P\d+\s+)?(.*?);"
    found = re.findall(pattern, _listed(cubin, "-sass"), re.MULTILINE)
    return [(int(address, 16), text.strip()) for address, text in found]


def _listed(cubin: bytes, what: str) -> str:
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        Path(file.name).write_bytes(cubin)
        command = [_TOOLS / "cuobjdump", what, file.name]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def _tiles(ttgir: str) -> list[dict]:
    """Loads and stores of tiles [rows, columns] in blocked layouts: numbers that a lane holds, lanes on both axes."""
    lists = r"sizePerThread = \[(.*?)\], threadsPerWarp = \[(.*?)\], warpsPerCTA = \[.*?\], order = \[1, 0\]"
    layouts = {name: found for name, *found in re.findall(rf"^(#\w+) = #ttg.blocked<{{{lists}}}>", ttgir, re.MULTILINE)}
    tiles = []
    for kind, rows, columns, layout in re.findall(
        r"tt\.(load|store) .*tensor<(\d+)x(\d+)x!tt\.ptr<f32>, (#blocked\w*)>", ttgir
    ):
        held, lanes = ([int(number) for number in text.split(",")] for text in layouts[layout])
        tiles.append({"kind": kind, "shape": [int(rows), int(columns)], "held": held, "lanes": lanes})
    return tiles


def _per_sample(instructions: list[tuple[int, str]]) -> float | None:
    """Instructions of the shortest loop around powers of two, per power: each (splat, pixel) sample takes one."""
    loops = []
    for address, text in instructions:
        jump = re.match(r"BRA\S*\s+.*?(0x[0-9a-f]+)", text)
        if jump and int(jump[1], 16) < address:
            body = [other for at, other in instructions if int(jump[1], 16) <= at <= address]
            powers = sum(other.startswith("MUFU.EX2") for other in body)
            if powers:
                loops.append((len(body), len(body) / powers))
    return min(loops)[1] if loops else None


if __name__ == "__main__":
    given = json.load(sys.stdin)
    json.dump([compile_launch(launch, given["arch"]) for launch in given["launches"]], sys.stdout)
