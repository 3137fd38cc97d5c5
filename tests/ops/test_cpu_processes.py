"""The C++ backend in other processes: forked and spawned workers, and loaded before torch."""

import sys

import pytest

from sparsestreet.ops.cpu.library import find_library
from tests.ops.test_cpu_compilers import run

pytestmark = pytest.mark.slow
SCENE = """
import torch
from sparsestreet.ops import splat
from tests.ops.scenes import camera, cast, random_gaussians

torch.set_num_threads(2)
view = camera(70, 50)
scene = random_gaussians(300, view)


def image():
    leaves = cast(scene, torch.float32, requires_grad=True)
    rgb = splat(leaves, view, backend="cpu").rgb
    rgb.sum().backward()
    return rgb.detach(), leaves.dense_sh().grad
"""
WORKER = """
import multiprocessing

def work(queue):
    queue.put([part.numpy() for part in image()])

if __name__ == "__main__":
    expected = [part.numpy() for part in image()]  # starts the threads that a forked child lacks
    for method in ("fork", "spawn"):
        context = multiprocessing.get_context(method)
        queue = context.Queue()
        worker = context.Process(target=work, args=(queue,), daemon=True)
        worker.start()
        result = queue.get(timeout=60)
        assert all((a == b).all() for a, b in zip(expected, result, strict=True)), method
        worker.join(60)
        assert worker.exitcode == 0, method
"""
LOADED_FIRST = """
import ctypes, sys
ctypes.CDLL(sys.argv[1])
"""
SUBNORMALS = """
rgb, gradient = image()
assert rgb.any() and gradient.any()
assert torch.tensor(1e-40) * torch.tensor(0.5) > 0, "the library switched the process to flush-to-zero"
# In torch's own threads as well.
assert (torch.full((1 << 22,), 1e-40) * 0.5 > 0).all()
"""


def test_loaded_after_torch_and_in_forked_and_spawned_processes(tmp_path):
    script = tmp_path / "script.py"  # which a spawned worker imports
    script.write_text(SCENE + SUBNORMALS + WORKER)
    run(sys.executable, str(script))


def test_loaded_before_torch(tmp_path):
    run(sys.executable, "-c", LOADED_FIRST + SCENE + SUBNORMALS, str(find_library()))
