"""The C++ library by other compilers and for other systems; where one is missing, its test is skipped."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from sparsestreet.ops import splat
from sparsestreet.ops.cpu.library import LIBRARY_NAME, LIBRARY_VARIABLE
from tests.ops.scenes import camera, cast, random_gaussians, relative_error

ROOT = Path(__file__).parents[2]
DRAW = """
import sys
import torch
from sparsestreet.ops.cpu import rasterizer
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.ops import SplatSettings
gaussians, view = torch.load(sys.argv[1], weights_only=False)
variants = [v for v in range(3) if load_library().splat_variant_name(v) is not None]
offsets = gaussians.means.new_zeros(len(gaussians), 2)
images = [rasterizer.rasterize(gaussians, offsets, view, SplatSettings(), v).rgb for v in variants]
torch.save(images, sys.argv[1])
"""
ON_DARWIN = ("-DCMAKE_SYSTEM_NAME=Darwin", "-DCMAKE_SYSTEM_PROCESSOR=arm64", "-DCMAKE_CXX_COMPILER=g++")
ON_ARM = ("-DCMAKE_SYSTEM_NAME=Linux", "-DCMAKE_SYSTEM_PROCESSOR=aarch64")


def run(*command: str, **environment: str) -> str:
    known = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    made = subprocess.run(
        command, cwd=ROOT, env=known | environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert made.returncode == 0, made.stdout + made.stderr
    return made.stdout


def require(*programs: str) -> None:
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(f"there is no {program}")


def built(folder: Path, compiler: str, *options: str) -> Path:
    require("cmake", compiler)
    run("cmake", "-S", ".", "-B", str(folder), f"-DCMAKE_CXX_COMPILER={compiler}", *options)
    run("cmake", "--build", str(folder))
    return folder / LIBRARY_NAME


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["g++-11", "clang++"])
def test_other_compilers_draw_the_same(compiler, tmp_path):
    require(compiler)
    if compiler == "clang++" and not links_openmp(compiler, tmp_path):
        pytest.skip("this clang++ has no OpenMP runtime")
    library = built(tmp_path / "build", compiler)
    view = camera(75, 53)
    gaussians = cast(random_gaussians(250, view), torch.float64)
    torch.save((gaussians, view), tmp_path / "scene.pt")
    run(sys.executable, "-c", DRAW, str(tmp_path / "scene.pt"), **{LIBRARY_VARIABLE: str(library)})
    expected = splat(gaussians, view, backend="reference").rgb
    images = torch.load(tmp_path / "scene.pt")
    assert images
    for image in images:
        # As tests of accuracy ask of the default build.
        assert relative_error(image, expected) < 1e-12


def links_openmp(compiler: str, place: Path) -> bool:
    """Debian's clang comes without one."""
    (place / "empty.cpp").write_text("int main() {}\n", encoding="utf-8")
    command = [compiler, "-fopenmp", "empty.cpp", "-o", "empty"]
    return subprocess.run(command, cwd=place, capture_output=True, check=False).returncode == 0


@pytest.mark.slow
def test_it_compiles_for_arm(tmp_path):
    library = built(tmp_path, "aarch64-linux-gnu-g++", *ON_ARM).read_bytes()
    assert int.from_bytes(library[18:20], "little") == 183  # the ELF header's e_machine: AArch64
    assert b"baseline" in library
    assert b"x86-64-v3" not in library


@pytest.mark.slow
def test_macos_gets_the_same_name_and_the_openmp_runtime_of_torch(tmp_path):
    """The command that would link it, configured for macOS with the compiler that is here."""
    require("cmake", "make", "g++")
    run("cmake", "-G", "Unix Makefiles", "-S", ".", "-B", str(tmp_path), *ON_DARWIN)
    words = (tmp_path / "CMakeFiles" / "sparsestreet_splat.dir" / "link.txt").read_text(encoding="utf-8").split()
    assert words[words.index("-o") + 1] == LIBRARY_NAME
    assert "-Wl,-undefined,dynamic_lookup" in words
    assert not [word for word in words if "omp" in word.lower()]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads what Linux says of a process")
def test_a_process_has_one_openmp_runtime():
    """Two would each have their threads: ours must be known by the name that torch's has (pyproject.toml, wheels)."""
    loaded = run(
        sys.executable,
        "-c",
        "from sparsestreet.ops.cpu.library import load_library; load_library(); print(open('/proc/self/maps').read())",
    )
    runtimes = set(re.findall(r"/\S*/lib[gi]?omp\S*", loaded))
    assert len(runtimes) == 1, runtimes
