"""What only the Triton backend refuses, with the remedy: tensors and devices that it cannot take."""

import subprocess
import sys

import pytest
import torch

from sparsestreet.ops import PairLimitError, backend, contribution, resolve_backend, splat
from sparsestreet.ops.triton import rasterizer
from sparsestreet.types import Gaussians
from tests.ops.scenes import camera, cast, device_of, front_camera, one_gaussian

VIEW = camera(9, 7)


def test_pairs_beyond_32_bits_are_counted_not_allocated():
    # The largest image, 2^18 x 8 tiles, covered by 1050 giants of 5e8 px: more than 2^31 pairs.
    giant = one_gaussian(scales=[[1e7] * 3], opacities=[1.0])
    gaussians = cast(Gaussians.concatenate([giant] * 1050), torch.float32, device=device_of("triton"))
    with pytest.raises(PairLimitError, match=f"cover {1050 * 2**21} tiles"):
        contribution(gaussians, front_camera(2**22, 128, 100.0), backend="triton")


def test_float64_is_refused():
    with pytest.raises(ValueError, match=r"'triton' computes in float32, got torch.float64: convert"):
        splat(one_gaussian(), VIEW, backend="triton")


def test_cpu_tensors_need_the_interpreter(monkeypatch):
    monkeypatch.setattr(rasterizer, "is_interpreted", lambda kernel: False)
    with pytest.raises(ValueError, match=r"'triton' needs tensors on a CUDA device, got cpu: move them, .*INTERPRET=1"):
        splat(cast(one_gaussian(), torch.float32), VIEW, backend="triton")


def test_the_op_does_not_import_triton_before_it_is_used():
    code = "import sys, sparsestreet.ops; sys.exit('triton' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_where_triton_runs(monkeypatch):
    cuda = torch.device("cuda")
    assert resolve_backend("auto", cuda) == "triton"
    assert resolve_backend("triton", cuda) == "triton"
    with pytest.raises(ValueError, match="needs tensors on a CUDA device, got meta"):
        resolve_backend("triton", torch.device("meta"))
    monkeypatch.setattr(backend, "has_triton", lambda: False)
    monkeypatch.setattr(backend, "_warned", set())
    with pytest.raises(RuntimeError, match="'triton' needs the package triton: pip install"):
        resolve_backend("triton", cuda)
    with pytest.warns(RuntimeWarning, match=r"triton is not installed.*pip install"):
        assert resolve_backend("auto", cuda) == "reference"
