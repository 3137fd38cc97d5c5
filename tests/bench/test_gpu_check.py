"""The check of a GPU: what it needs and leaves out, and a dry run in an environment made for it."""

import importlib.metadata
import os
import runpy
import shutil
import subprocess
import sys
import sysconfig
import time
import zipfile
from pathlib import Path

import pytest

from sparsestreet.ops.cpu import library
from sparsestreet.records.strict_json import write_json
from tests.evaluation.frames import make_summary
from tests.ops import scenes

pytestmark = pytest.mark.lengthy

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
TAG = "py3-none-any"


def check(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """The script in an environment without this process's paths."""
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "TMPDIR") if name in os.environ}
    return subprocess.run(
        [str(SCRIPTS / "gpu_check.sh"), *arguments], env=kept | environment, capture_output=True, text=True, check=False
    )


@pytest.fixture
def bare(tmp_path) -> Path:
    """The interpreter of a virtual environment without any package."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "bare"], check=True)
    return tmp_path / "bare" / "bin" / "python"


def write_wheel(folder: Path, name: str, files: dict[str, bytes], tag: str = TAG) -> None:
    folder.mkdir(exist_ok=True)
    with zipfile.ZipFile(folder / f"{name}-1.0-{tag}.whl", "w") as wheel:
        for file, content in files.items():
            wheel.writestr(file, content)


def test_what_is_missing_is_said_at_once_with_its_remedy(tmp_path, bare):
    began = time.monotonic()
    said = check(PYTHON=str(bare), OUT=str(tmp_path / "out"))
    assert said.returncode == 2
    assert time.monotonic() - began < 5  # a tenth of a second where nothing else runs
    lines = [line for line in said.stdout.splitlines() if line.startswith("needs    missing ")]
    for package, distribution in (("torch", "torch"), ("hydra", "hydra-core"), ("xdist", "pytest-xdist")):
        (line,) = [line for line in lines if f"  no {package} (" in line]
        assert line.endswith(f": pip install {distribution}, or its wheel into SPARSESTREET_WHEELS")


def test_what_triton_calls_is_looked_for(monkeypatch):
    tools = runpy.run_path(str(SCRIPTS / "gpu_needs.py"))["missing_tools"]
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(sysconfig, "get_path", lambda name: "/nowhere")
    monkeypatch.setattr(Path, "is_file", lambda path: False)
    assert [line.split(" (")[0] for line in tools()] == ["no C compiler", "no /nowhere/Python.h", "no nvcc", "no ninja"]
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}")
    monkeypatch.setattr(Path, "is_file", lambda path: True)
    assert tools() == []


def test_wheels_are_unpacked_before_packages_are_looked_for(tmp_path):
    write_wheel(tmp_path / "wheels", "gsplat", {"gsplat/__init__.py": b""})
    write_wheel(tmp_path / "wheels", "other", {"other.py": b""}, "cp27-cp27m-win32")
    site = tmp_path / "site"
    site.mkdir()
    environment = os.environ | {"PYTHONPATH": str(site)}
    said = subprocess.run(
        [sys.executable, SCRIPTS / "gpu_needs.py", site, tmp_path / "wheels"],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "no gsplat" not in said
    assert "other-1.0-cp27-cp27m-win32.whl is for another Python" in said
    assert [path.name for path in site.iterdir()] == ["gsplat"]
    unpack = runpy.run_path(str(SCRIPTS / "gpu_needs.py"))["unpack_wheels"]
    assert unpack(tmp_path / "nowhere", site) == [f"no folder {tmp_path / 'nowhere'}: SPARSESTREET_WHEELS names none"]


PRETENDS = """
import os, sys, time
from pathlib import Path

given, folder = " ".join(sys.argv[1:]), Path(__file__).parent
trained = folder / "trained"


def call(name):
    with (folder / "calls").open("a") as file:
        file.write(f"{name}: {given}\\n")


if "gpu_says.py machine" in given:
    print("a device", "9.0", "/a/library.so", sep="\\n")
elif given == "-m sparsestreet check":
    call("check")
    print("device    MISSING: a driver" if MODE == "failing" else "a GPU trains here")
    sys.exit(MODE == "failing")
elif "gsplat.cuda._backend" in given:
    while MODE == "slow" and not trained.exists():
        time.sleep(0.02)
    print("error: of nvcc\\nmore" if MODE == "failing" else "compiled: True")
elif "test_parity.py" in given and "--ignore=" not in given:
    call("parity")
    time.sleep(0.5)  # the compiler has ended, where it is not slow
    print("FAILED tests/ops/test_it.py::test_this - it is so\\n1 failed, 2 passed in 3 s")
    sys.exit(1)
elif "-m pytest" in given:
    call("kernels")
    print("left out: tests/ops/test_that.py (no hypothesis)\\n7 passed, 1 skipped in 3 s")
elif "gpu_says.py training" in given:
    print("trained")
elif " train " in given:
    call("train")
    (out,) = (item.removeprefix("out=") for item in sys.argv if item.startswith("out="))
    Path(out, "records").mkdir(parents=True)
    Path(out, "records", "summary.json").write_text("{}")
    trained.touch()
    time.sleep(0.5)
elif " benchmarks.gpu" in given:
    call("bench")
    stubs = [Path(path, "gsplat.py") for path in os.environ["PYTHONPATH"].split(os.pathsep)]
    print("sparsestreet triton", "alone" if any(stub.is_file() for stub in stubs) else "beside gsplat")
"""
TIMEOUT = """#!/bin/sh
printf 'timeout: %s\\n' "$*" >>"$(dirname "$0")/calls"
while case "$1" in --*) true ;; *) false ;; esac; do shift; done
shift
exec "$@"
"""


def run_on_a_pretended_device(folder: Path, mode: str) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """The script with a Python and a timeout that note what they are called with; the calls."""
    pretended = f"#!{sys.executable} -S\nMODE = {mode!r}\n{PRETENDS}"
    for name, text in (("python", pretended), ("timeout", TIMEOUT)):
        (folder / name).write_text(text, encoding="utf-8")
        (folder / name).chmod(0o755)
    path = os.pathsep.join([str(folder), os.environ["PATH"]])
    said = check(PATH=path, PYTHON=str(folder / "python"), OUT=str(folder / "out"))
    return said, (folder / "calls").read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize(
    ("gsplat", "order", "beside"),
    [
        ("compiled", ["check", "parity", "bench", "train", "kernels"], "beside gsplat"),
        ("slow", ["check", "parity", "train", "bench", "kernels"], "beside gsplat"),
        ("failing", ["check", "parity", "bench", "train", "kernels"], "alone"),
    ],
)
def test_the_order_of_the_parts_and_their_table(tmp_path, gsplat, order, beside):
    said, calls = run_on_a_pretended_device(tmp_path, gsplat)
    assert [call.split(":")[0] for call in calls if not call.startswith("timeout")] == order
    table = (tmp_path / "out" / "table.txt").read_text(encoding="utf-8").splitlines()
    states = {line[:8].strip(): line[9:17].strip() for line in table if line[25:26] == "s"}
    failed = ["parity"] + ["gsplat", "check"] * (gsplat == "failing")
    expected = dict.fromkeys((*order, "gsplat"), "ok") | {"build": "skipped"} | dict.fromkeys(failed, "failed")
    assert states == expected, said.stdout + said.stderr
    assert said.returncode == 1
    assert any("FAILED tests/ops/test_it.py::test_this - it is so" in line for line in table)
    assert any("tests/ops/test_that.py (no hypothesis)" in line for line in table)
    assert any(line.strip() == "trained" for line in table)
    for said_of_it in ("error: of nvcc", "device    MISSING: a driver"):
        assert any(said_of_it in line for line in table) == (gsplat == "failing")
    assert table[-1] == f"sparsestreet triton {beside}"


def test_parts_end_as_by_ctrl_c_and_tests_keep_going_at_warnings(tmp_path):
    _, calls = run_on_a_pretended_device(tmp_path, "compiled")
    parts = [call for call in calls if call.startswith("timeout") and "gsplat.cuda" not in call]
    assert len(parts) == 5
    assert all(call.startswith("timeout: --signal=INT --kill-after=10 ") for call in parts)
    for call in calls:
        if call.startswith(("parity", "kernels")):
            assert "-rfE" in call
            assert "-o filterwarnings=default" in call
            assert "--dist load" in call
            named = [ROOT / word for word in call.split() if word.startswith("tests/")]
            assert named
            assert all(path.exists() for path in named)


def test_files_without_their_packages_are_left_out_and_named(tmp_path):
    files = {
        "good": "",
        "lacking": "import nowhere_to_be_found.part",
        "broken": "from sparsestreet.ops import nothing_of_this_name",
        "typo": "import sparsestreet.opps",
    }
    for name, text in files.items():
        (tmp_path / f"test_{name}.py").write_text(f"{text}\ndef test_it(): pass\n", encoding="utf-8")
    # Names of files are relative to the folder of the settings.
    (tmp_path / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "leave_out_missing", "-p", "no:cacheprovider"]
    path = os.pathsep.join([str(SCRIPTS), os.environ.get("PYTHONPATH", "")])
    for more, broken in (([], 0), (["--continue-on-collection-errors"], 2)):
        run = subprocess.run(
            [*command, *more, *(() if broken else ("test_good.py", "test_lacking.py"))],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": path, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        lines = run.stdout.splitlines()
        assert [line for line in lines if line.startswith("left out:")] == [
            "left out: test_lacking.py (no nowhere_to_be_found)"
        ], run.stdout + run.stderr
        assert "1 passed, 1 skipped" in lines[-1]
        assert (f"{broken} errors" in lines[-1], run.returncode) == (broken > 0, int(broken > 0))


def test_the_line_about_the_training_is_of_todays_records(tmp_path, capsys):
    write_json(tmp_path / "train.json", make_summary())
    runpy.run_path(str(SCRIPTS / "gpu_says.py"))["training"](tmp_path / "train.json")
    assert capsys.readouterr().out == "100.0 s of training, held-out PSNR 25.00 dB\n"


def test_without_the_library_its_backend_is_left_out(monkeypatch):
    monkeypatch.setattr(library, "find_library", lambda: None)
    found = runpy.run_path(str(ROOT / "tests" / "ops" / "scenes.py"))
    assert "cpu" not in found["BACKENDS"]
    assert found["BACKENDS"][0] == "reference"
    assert "cpu" in scenes.BACKENDS


BY_WHEEL = ("hydra-core", "omegaconf", "antlr4-python3-runtime", "beartype")
"""What a machine for training networks lacks; it has the other packages."""


def give_packages(python: Path, without: tuple[str, ...]) -> None:
    """Links to all packages of this environment but some and the project's own."""
    site = next((python.parent.parent / "lib").iterdir()) / "site-packages"
    left_out = {name for distribution in without for name in top_level(distribution)}
    for package in Path(sysconfig.get_path("purelib")).iterdir():
        if package.name not in left_out and "sparsestreet" not in package.name and package.suffix != ".pth":
            (site / package.name).symlink_to(package)


def top_level(distribution: str) -> set[str]:
    return {file.parts[0] for file in importlib.metadata.files(distribution) or () if file.parts[0] != ".."}


@pytest.mark.slow
def test_a_dry_run_where_only_wheels_bring_the_rest(tmp_path, bare):
    for distribution in BY_WHEEL:
        files = [file for file in importlib.metadata.files(distribution) or () if file.parts[0] != ".."]
        contents = {str(file): Path(file.locate()).read_bytes() for file in files if file.suffix != ".pyc"}
        write_wheel(tmp_path / "wheels", distribution.replace("-", "_"), contents)
    give_packages(bare, without=(*BY_WHEEL, "hypothesis"))
    said = check(
        "--dry-run",
        PYTHON=str(bare),
        OUT=str(tmp_path / "out"),
        SPARSESTREET_WHEELS=str(tmp_path / "wheels"),
        SPARSESTREET_SPLAT_LIBRARY=str(library.find_library()),
    )
    table = (tmp_path / "out" / "table.txt").read_text(encoding="utf-8").splitlines()
    states = {line[:8].strip(): line[9:17].strip() for line in table if line[25:26] == "s"}
    assert states.pop("needs") == "missing"
    assert states == dict.fromkeys(("parity", "bench", "train", "kernels"), "ok") | dict.fromkeys(
        ("build", "gsplat"), "skipped"
    ), said.stdout + said.stderr
    assert said.returncode == 0
    assert any("no hypothesis (test files left out)" in line for line in table)
    assert any(line.startswith("sparsestreet cpu") for line in table)
