"""Launches one kernel with arguments of many kinds, and says which machine code each launch got.

Run as a script, without TRITON_INTERPRET: names of kinds come in as JSON on standard input, by the version that Triton
is said to have (its own where that is empty).
"""

import json
import sys
from functools import partial

import torch
import triton
import triton.language as tl

from sparsestreet.ops.triton.launch import jit, launch
from tests.ops.triton.fake_driver import FakeDevice, install


@partial(jit, do_not_specialize=["count"])
def scale(to, values, factor, count, EXACT: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    scaled = tl.load(values + i, i < count) * factor
    tl.store(to + i, scaled if EXACT else scaled + 1, i < count)


TO, VALUES = torch.zeros(64), torch.zeros(64)
KINDS = {
    "plain": (TO, VALUES, 7, 50, True),
    "another plain": (TO.clone(), VALUES[32:], -9, 3, True),
    "unaligned target": (TO[1:], VALUES, 7, 50, True),
    "unaligned source": (TO, VALUES[2:], 7, 50, True),
    "doubles": (TO, VALUES.double(), 7, 50, True),
    "one": (TO, VALUES, 1, 50, True),
    "sixteens": (TO, VALUES, 48, 50, True),
    "zero": (TO, VALUES, 0, 50, True),
    "long": (TO, VALUES, 2**31 + 1, 50, True),
    "least int": (TO, VALUES, -(2**31), 50, True),
    "long sixteens": (TO, VALUES, 2**31, 50, True),
    "float": (TO, VALUES, 7.0, 50, True),
    "count of one": (TO, VALUES, 7, 1, True),
    "other constant": (TO, VALUES, 7, 50, False),
    "other block": (TO, VALUES, 7, 50, True),
    "other options": (TO, VALUES, 7, 50, True),
}


def start(name: str) -> None:
    *arguments, exact = KINDS[name]
    options = {"num_warps": 2 if name == "other options" else 1}
    launch(scale, arguments[3], 32 if name == "other block" else 16, *arguments, EXACT=exact, options=options)


def measure(device: FakeDevice, names: list[str]) -> list[dict]:
    """Of each launch: the number of its machine code, what it was specialized for, whether Triton bound it anew."""
    bound, run = [], scale.run

    def watched(*arguments, **options):
        bound.append(1)
        return run(*arguments, **options)

    scale.run = watched
    answers = []
    for name in names:
        bound.clear()
        start(name)
        binary = device.launches[-1]
        types = [kind for kind in binary.source.signature.values() if kind != "constexpr"]
        code = next(i for i, other in enumerate(device.binaries) if other is binary)
        answers.append({"code": code, "known": binary.specialized(), "types": types, "bound": bool(bound)})
    return answers


if __name__ == "__main__":
    fake = FakeDevice()
    install(fake)
    version, answers = triton.__version__, {}
    for other, names in json.load(sys.stdin).items():
        triton.__version__ = other or version
        answers[other] = measure(fake, names)
    json.dump(answers, sys.stdout)
