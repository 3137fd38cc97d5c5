"""What the Triton backend refuses, with the remedy: bad values, too many pairs, tensors and devices it cannot take."""

import dataclasses
import subprocess
import sys

import pytest
import torch

from sparsestreet.ops import PairLimitError, backend, contribution, resolve_backend, splat
from sparsestreet.ops.triton import lists, rasterizer
from sparsestreet.types import Gaussians
from tests.ops.scenes import FIELDS, camera, cast, device_of, front_camera, one_gaussian, random_gaussians

DEVICE = device_of("triton")
VIEW = camera(9, 7)


def single(gaussians: Gaussians) -> Gaussians:
    return cast(gaussians, torch.float32, device=DEVICE)


@pytest.mark.parametrize("poison", [float("nan"), -float("inf")])
@pytest.mark.parametrize("field", FIELDS)
def test_value_that_is_not_finite(field, poison):
    gaussians = single(random_gaussians(5, VIEW, terms=4))
    getattr(gaussians, field)[3].view(-1)[-1] = poison
    with pytest.raises(ValueError, match=f"{field} must be finite, but row 3 has {poison}"):
        splat(gaussians, VIEW, backend="triton")


@pytest.mark.parametrize(("field", "value"), [("opacities", 1.5), ("opacities", -0.5), ("scales", -0.5)])
def test_values_out_of_range(field, value):
    gaussians = single(random_gaussians(5, VIEW))
    getattr(gaussians, field)[3] = value
    with pytest.raises(ValueError, match=f"{field} must .*row 3 has {value}"):
        contribution(gaussians, VIEW, backend="triton")


def test_displacements_that_are_not_finite():
    displacements = torch.zeros(5, 3)
    displacements[2, 1] = float("nan")
    gaussians = single(dataclasses.replace(random_gaussians(5, VIEW), displacements=displacements.double()))
    with pytest.raises(ValueError, match="displacements must be finite, but row 2 has nan"):
        splat(gaussians, VIEW, backend="triton")


def test_more_pairs_than_may_be_held(monkeypatch):
    view = front_camera(64, 48, 40.0)
    giant = one_gaussian(scales=[[90.0] * 3])
    gaussians = Gaussians.concatenate([one_gaussian(means=[[0.0, 0.0, -2.0]]), giant, one_gaussian()])
    # The ball of 0.1 m lies in the middle and reaches 7 px: tiles 1, 2 of rows 1; and the giant covers all 4 x 3.
    monkeypatch.setattr(lists, "PAIR_LIMIT", 13)
    with pytest.raises(PairLimitError, match=r"cover 14 tiles, more than the 13.*row 1 \(12\), row 2 \(2\)\. Prune"):
        contribution(single(gaussians), view, backend="triton")


def test_pairs_beyond_32_bits_are_counted_not_allocated():
    # The largest image, 2^18 x 8 tiles, covered by 1050 giants of 5e8 px: more than 2^31 pairs.
    giant = one_gaussian(scales=[[1e7] * 3], opacities=[1.0])
    gaussians = single(Gaussians.concatenate([giant] * 1050))
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
