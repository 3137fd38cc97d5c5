"""Each part of what a GPU needs, missing in turn, is named with its remedy."""

import shutil
import sys
import sysconfig
import warnings

import pytest
import torch

from sparsestreet.bench import accuracy
from sparsestreet.cli.commands import gpu_check as command
from sparsestreet.cli.commands.gpu_check import PARTS, check


@pytest.fixture
def gpu(monkeypatch, tmp_path):
    """A machine on which everything is there; the CPU draws in the place of the device."""
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA H100")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (78.5e9, 80.0e9))
    ones = torch.ones
    monkeypatch.setattr(torch, "ones", lambda *size, device=None, **how: ones(*size, **how))
    monkeypatch.setattr(command, "has_driver", lambda: True)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.delenv("CC", raising=False)
    (tmp_path / "Python.h").write_text("")
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(tmp_path))
    answer = accuracy.answer

    def on_the_host(rows, camera, settings, backend, dtype, device="cpu"):
        assert (backend, device) in (("triton", "cuda"), ("reference", "cpu"))
        return answer(rows, camera, settings, "reference", dtype)

    monkeypatch.setattr(accuracy, "answer", on_the_host)
    return monkeypatch


def test_a_machine_that_has_everything(gpu, capsys):
    assert check([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:10].strip() for line in lines[:-1]] == list(PARTS)
    assert lines[1] == "device    NVIDIA H100, compute capability 9.0"
    assert lines[4] == "memory    78.5 of 80.0 GB are free"
    assert lines[5].startswith("splat     200 Gaussians as on the CPU, with gradients: ")
    assert lines[-1] == "a GPU trains here: sparsestreet train trainer=gpu"


def said(capsys: pytest.CaptureFixture[str], part: str) -> str:
    """The line of the part that is missing, the last; those before are there."""
    assert check([]) == 1
    *before, last = capsys.readouterr().out.splitlines()
    assert [line[:10].strip() for line in before] == list(PARTS)[: list(PARTS).index(part)]
    assert not any("MISSING" in line for line in before)
    assert last.startswith(f"{part:<10}MISSING: ")
    return last


@pytest.mark.parametrize("driver", [True, False])
def test_a_build_of_torch_without_cuda_is_one_line(gpu, capsys, driver):
    gpu.setattr(torch.version, "cuda", None)
    gpu.setattr(command, "has_driver", lambda: driver)
    line = said(capsys, "torch")
    assert f"torch {torch.__version__} is a build without CUDA" in line
    assert "--index-url https://download.pytorch.org/whl/cu130" in line
    assert ("install its driver" in line) != driver


def test_a_torch_whose_libraries_do_not_load(gpu, capsys):
    gpu.setitem(sys.modules, "torch", None)  # makes the import fail
    assert "torch cannot be imported (" in said(capsys, "torch")


def test_a_driver_that_is_too_old(gpu, capsys):
    def too_old() -> bool:
        said = "CUDA initialization: the driver is too old (found 12020). (Triggered internally at x.cpp:1)"
        warnings.warn(said, stacklevel=2)
        return False

    gpu.setattr(torch.cuda, "is_available", too_old)
    line = said(capsys, "device")
    assert "the driver is too old (found 12020).: a driver must be as new as CUDA 13.0" in line
    assert "Triggered" not in line


def test_a_device_that_is_too_old_for_kernels(gpu, capsys):
    gpu.setattr(torch.cuda, "get_device_capability", lambda: (7, 5))
    assert "compute capability 7.5, and kernels need 8.0" in said(capsys, "device")


def test_a_device_that_this_build_has_no_code_for(gpu, capsys):
    def unknown(*size, **how):
        raise RuntimeError("CUDA error: no kernel image is available for execution on the device\nmore")

    gpu.setattr(torch, "ones", unknown)
    line = said(capsys, "device")
    assert "cannot compute on NVIDIA H100, compute capability 9.0: CUDA error: no kernel image" in line
    assert "pip install -c constraints.txt torch" in line


def test_no_compiler(gpu, capsys):
    gpu.setattr(shutil, "which", lambda name: None)
    assert "there is no C compiler, and Triton calls one: apt-get install gcc" in said(capsys, "compiler")
    gpu.setenv("CC", "icc")
    assert "the C compiler that CC names (icc) is not there" in said(capsys, "compiler")


def test_no_headers_and_no_triton(gpu, capsys):
    gpu.setitem(sys.modules, "triton", None)  # makes the import fail
    line = said(capsys, "headers")
    assert "Triton cannot be imported" in line
    assert "pip install 'sparsestreet[gpu]'" in line
    gpu.setattr(sysconfig, "get_path", lambda name: "/nowhere")
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert f"there is no /nowhere/Python.h, which Triton compiles with: apt-get install python{version}-dev" in said(
        capsys, "headers"
    )


def test_no_memory(gpu, capsys):
    gpu.setattr(torch.cuda, "mem_get_info", lambda: (0.4e9, 80.0e9))
    assert "0.4 of 80.0 GB are free: nvidia-smi lists who holds the rest" in said(capsys, "memory")


def test_a_kernel_that_does_not_compile(gpu, capsys):
    def broken(*given):
        raise RuntimeError("ptxas fatal: Unsupported .version 9.2\nmore")

    gpu.setattr(accuracy, "answer", broken)
    line = said(capsys, "splat")
    assert "RuntimeError: ptxas fatal: Unsupported .version 9.2; with the versions of constraints.txt" in line
    assert "more" not in line


@pytest.mark.parametrize("part", ["image", "gradients"])
def test_a_device_that_draws_something_else(gpu, capsys, part):
    right = accuracy.answer

    def wrong(*given):
        found = right(*given)
        if given[3] == "triton" and part == "image":
            found.image.mul_(1.01)
        elif given[3] == "triton":
            found.gradients["sh"].mul_(1.01)
        return found

    gpu.setattr(accuracy, "answer", wrong)
    assert "the device draws another image than the CPU" in said(capsys, "splat")


def test_words(capsys):
    assert check(["--help"]) == 0
    assert "whether a GPU can train here" in capsys.readouterr().out
    assert check(["now"]) == 2
    assert "takes no arguments, got now" in capsys.readouterr().err
