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


def too_old() -> bool:
    said = "CUDA initialization: the driver is too old (found 12020). (Triggered internally at x.cpp:1)"
    warnings.warn(said, stacklevel=2)
    return False


def fails(message: str):
    def raises(*given, **how):
        raise RuntimeError(f"{message}\nmore")

    return raises


MISSING = [
    # What is replaced and by what, the part that is missing, what is said.
    (torch.version, "cuda", None, "torch", "is a build without CUDA: pip uninstall torch"),
    (torch.cuda, "is_available", too_old, "device", "the driver is too old (found 12020).: a driver must be as new as"),
    (torch.cuda, "get_device_capability", lambda: (7, 5), "device", "compute capability 7.5, and kernels need 8.0"),
    (torch, "ones", fails("CUDA error: no kernel image"), "device", "cannot compute on NVIDIA H100"),
    (shutil, "which", lambda name: None, "compiler", "there is no C compiler, and Triton calls one"),
    (sysconfig, "get_path", lambda name: "/nowhere", "headers", "there is no /nowhere/Python.h, which Triton compiles"),
    (torch.cuda, "mem_get_info", lambda: (0.4e9, 80.0e9), "memory", "0.4 of 80.0 GB are free: nvidia-smi lists who"),
    (accuracy, "answer", fails("ptxas fatal"), "splat", "RuntimeError: ptxas fatal; with the versions"),
]


@pytest.mark.parametrize(
    ("owner", "name", "replaced", "part", "text"), MISSING, ids=[f"{one[3]} {one[1]}" for one in MISSING]
)
def test_what_is_missing_is_one_line_with_its_remedy(gpu, capsys, owner, name, replaced, part, text):
    gpu.setattr(owner, name, replaced)
    line = said(capsys, part)
    assert text in line
    assert "more" not in line
    assert "Triggered" not in line


@pytest.mark.parametrize(
    ("module", "part", "text"),
    [("torch", "torch", "torch cannot be imported ("), ("triton", "headers", "pip install 'sparsestreet[gpu]'")],
)
def test_what_cannot_be_imported(gpu, capsys, module, part, text):
    gpu.setitem(sys.modules, module, None)  # makes the import fail
    assert text in said(capsys, part)


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
