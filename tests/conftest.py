"""What all tests share: where recorded data may lie, and how long a test may take."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jaxtyping
import pytest
import torch

from tests.cpu_limit import CpuLimit
from tests.workers import CompiledOnce

if not torch.cuda.is_available():
    # Before anything imports triton: its kernels are then interpreted, on CPU tensors.
    os.environ.setdefault("TRITON_INTERPRET", "1")

# Modules and tests stay: the collector need not look at them again and again (7 % of all time).
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.set_threshold(20_000)
    gc.enable()


pytest_plugins = ["pytester"]


def pytest_configure(config: pytest.Config) -> None:
    # On a GPU the first launch of a kernel compiles it.
    if not torch.cuda.is_available():
        config.pluginmanager.register(CpuLimit())
    if "PYTEST_XDIST_WORKER" in os.environ:
        tests = Path(__file__).parent
        config.pluginmanager.register(
            CompiledOnce(tests / "viewing/__pycache__", tests.parent / ".cache/compiling.lock")
        )


@pytest.fixture(autouse=True)
def seeded() -> None:
    """A test that draws from torch's own generator draws the same alone and behind any others."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def kitti() -> Path:
    """The KITTI drive in DriveStudio's layout; skips where it is absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    root = Path(os.environ.get("SPARSESTREET_DATA", default)) / "kitti_0001"
    if not root.is_dir():
        pytest.skip(f"no recorded drive at {root}: set SPARSESTREET_DATA to the folder that holds kitti_0001")
    return root


@contextmanager
def unchecked() -> Iterator[None]:
    """Without checks of shapes, for what other tests are about: the tracer's many small calls take four times as long
    with them."""
    with _disabled(True):
        yield


@contextmanager
def checked() -> Iterator[None]:
    """With checks of shapes, where a training has ended them (cli/conftest.py)."""
    with _disabled(False):
        yield


@contextmanager
def _disabled(disabled: bool) -> Iterator[None]:
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", disabled)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)
