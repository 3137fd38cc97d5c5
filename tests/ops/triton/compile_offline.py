"""Compiles kernels for GPUs that need not be there, and counts what the machine code holds.

Run as a script, without TRITON_INTERPRET: launches (recorded by test_machine_code.py) come in as JSON on standard
input, what was compiled of them goes out as JSON.
"""

import bisect
import hashlib
import importlib
import itertools
import json
import re
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import triton
import triton.language as tl
from triton import knobs
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, CompiledKernel
from triton.runtime.jit import JITFunction

_TOOLS = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"


def compile_launches(launches: list[dict], arch: int) -> list[dict]:
    """Registers, spills, instructions per sample and tensor-core instructions of each launch on one architecture."""
    compiled = [_compile_launch(launch, arch) for launch in launches]
    machine_code = instructions_of([each.asm["cubin"] for each in compiled], arch)
    return [_found(each, instructions) for each, instructions in zip(compiled, machine_code, strict=True)]


def _compile_launch(launch: dict, arch: int) -> CompiledKernel:
    """It is compiled while the functions ``without`` are missing from the kernel's module."""
    module = importlib.import_module(launch["module"])
    missing = {name: getattr(module, name) for name in launch.get("without", ())}
    for name in missing:
        delattr(module, name)
    knobs.compilation.always_compile = bool(missing)
    try:
        return _compile(getattr(module, launch["name"]), launch, arch)
    finally:
        vars(module).update(missing)


def _compile(kernel: JITFunction, launch: dict, arch: int) -> CompiledKernel:
    constants = {name: _constant(value) for name, value in launch["constants"].items()}
    types = {**launch["types"], **dict.fromkeys(constants, "constexpr")}
    signature = {name: types[name] for name in kernel.arg_names}
    # Tensors begin at multiples of 16 bytes; whole numbers are taken as arbitrary, which costs most.
    attributes = {
        (i,): [["tt.divisibility", 16]] for i, name in enumerate(kernel.arg_names) if types[name].startswith("*")
    }
    source = ASTSource(kernel, signature, constants, attributes)
    return triton.compile(source, GPUTarget("cuda", arch, 32), options=launch["options"])


def _found(compiled: CompiledKernel, instructions: list[tuple[int, str]]) -> dict:
    forbidden, loops = forbidden_in(instructions), _loops(instructions)
    return {
        **resources_of(compiled.asm["cubin"]),
        **forbidden,
        "tensor_core": forbidden["tensor_core"] + compiled.asm["ptx"].count("tf32"),
        "sample": _per_sample(loops),
        "loops": loops,
        "loads": sum(text.startswith("LDG") for _, text in instructions),
        "stores": sum(text.startswith("STG") for _, text in instructions),
        "code": hashlib.sha256(repr(instructions).encode()).hexdigest(),
    }


def _constant(value: object) -> object:
    return tl.dtype(value["dtype"]) if isinstance(value, dict) else value


def resources_of(cubin: bytes) -> dict[str, int]:
    """Registers, and bytes of stack, where spilled registers go."""
    used = re.search(r"REG:(\d+) STACK:(\d+)", _listed("cuobjdump", cubin, "-res-usage"))
    return {"registers": int(used[1]), "spilled": int(used[2])}


def forbidden_in(instructions: list[tuple[int, str]]) -> dict[str, int]:
    """Instructions of the tensor cores, and atomics."""
    return {
        "tensor_core": sum(bool(re.match(r"[A-Z]*MMA", text)) for _, text in instructions),
        "atomics": sum(text.split()[0].startswith(("ATOM", "RED.", "REDG.")) for _, text in instructions),
    }


def instructions_of(cubins: list[bytes], arch: int) -> list[list[tuple[int, str]]]:
    """Of each, with addresses from its beginning. They are listed behind each other: to start takes the disassembler
    a third of a second, and a kernel hardly anything."""
    codes = [_code(cubin) for cubin in cubins]
    ends = list(itertools.accumulate(map(len, codes)))
    pattern = r"^\s*/\*([0-9a-f]{4,})\*/\s+(?:@!?U?P\d+\s+)?(.*?);"
    listed = re.findall(pattern, _listed("nvdisasm", b"".join(codes), "-b", f"SM{arch}"), re.MULTILINE)
    found: list[list[tuple[int, str]]] = [[] for _ in cubins]
    for address, text in listed:
        kernel = bisect.bisect_right(ends, int(address, 16))
        start = ends[kernel] - len(codes[kernel])
        found[kernel].append((int(address, 16) - start, _from(start, text.strip())))
    return found


def _code(cubin: bytes) -> bytes:
    """Its machine code: the one section .text of the file (ELF, 64 bits; its header, then those of its sections)."""
    (table,), (size, count, names) = struct.unpack_from("<Q", cubin, 40), struct.unpack_from("<HHH", cubin, 58)
    # Name and kind, flags and address, place in the file and length.
    sections = [struct.unpack_from("<IIQQQQ", cubin, table + i * size) for i in range(count)]
    texts = [one for one in sections if cubin.startswith(b".text.", sections[names][4] + one[0])]
    (_, _, _, _, start, length), = texts  # fmt: skip
    return cubin[start : start + length]


def _from(start: int, text: str) -> str:
    """With the target of a jump counted from the beginning of the kernel."""
    return re.sub(r"^((?:BRA|BSSY)\b.*)\b0x([0-9a-f]+)", lambda jump: f"{jump[1]}0x{int(jump[2], 16) - start:x}", text)


def _listed(tool: str, code: bytes, *options: str) -> str:
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        Path(file.name).write_bytes(code)
        command = [_TOOLS / tool, *options, file.name]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def _loops(instructions: list[tuple[int, str]]) -> list[dict[str, int]]:
    """The innermost loops around powers of two, of which each (splat, pixel) sample takes one, the longest last.

    Counted are all their instructions, the powers, loads from memory, exchanges between lanes, and what reads or
    writes spilled registers."""
    jumps = [(at, re.match(r"BRA\S*\s+.*?(0x[0-9a-f]+)", text)) for at, text in instructions]
    ranges = sorted({(int(jump[1], 16), at) for at, jump in jumps if jump and int(jump[1], 16) < at})
    loops = []
    for first, last in ranges:
        body = [text for at, text in instructions if first <= at <= last]
        kinds = {"powers": "MUFU.EX2", "loads": "LDG", "exchanges": "SHFL", "spilled": ("LDL", "STL")}
        counts = {name: sum(text.startswith(kind) for text in body) for name, kind in kinds.items()}
        if counts["powers"]:
            loops.append((first, last, {"instructions": len(body)} | counts))
    # The shortest of those that overlap.
    inner = [
        counts
        for first, last, counts in loops
        if not any(a <= last and first <= b and b - a < last - first for a, b, _ in loops)
    ]
    return sorted(inner, key=lambda counts: counts["instructions"])


def _per_sample(loops: list[dict[str, int]]) -> float | None:
    """Instructions of the longest loop per power of two."""
    return loops[-1]["instructions"] / loops[-1]["powers"] if loops else None


if __name__ == "__main__":
    given = json.load(sys.stdin)
    json.dump(compile_launches(given["launches"], given["arch"]), sys.stdout)
