"""A quarter of an hour on a GPU: what travels, the order of its parts, what comes home, and a dry run of both calls."""

import json
import os
import runpy
import shutil
import subprocess
import sys
import tarfile
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.synthetic import StreetSettings, make_street
from tests.bench.test_streets import made_street

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
TINY = StreetSettings(seed=3, num_frames=2, width=32, height=24, num_cameras=1, lens=(-0.1, 0.0, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Path:
    return make_street(TINY, tmp_path_factory.mktemp("streets") / "tiny")


@pytest.fixture
def packing(monkeypatch) -> dict[str, Any]:
    """What scripts/gpu_pack.py defines."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return runpy.run_path(str(SCRIPTS / "gpu_pack.py"))


def packed(packing: dict[str, Any], **given: Any) -> None:
    packing["pack"](packing["PackRequest"](wheels=False, **given))


@pytest.mark.lengthy
def test_a_street_travels_without_what_nobody_reads(tmp_path, packing, street, capsys):
    packed(packing, street=street, plain=made_street(tmp_path / "run"), out=tmp_path / "gpu")
    assert sorted(path.name for path in (tmp_path / "gpu").iterdir()) == [
        "plain.street", "street.options", "street.tar.xz",
    ]  # fmt: skip
    assert set((tmp_path / "gpu" / "street.options").read_text().split()) == {
        "seed=3",
        *(f"data.log.settings.{word}" for word in ("width=32", "height=24", "num_cameras=1", "num_frames=2")),
        "data.log.settings.lens=[-0.1,0.0,0.0,0.0,0.0]",
    }
    with tarfile.open(tmp_path / "gpu" / "street.tar.xz") as archive:
        archive.extractall(tmp_path / "there", filter="data")
    assert not (tmp_path / "there" / "depth").exists()
    before, after = (DriveStudioReader(folder).read() for folder in (street, tmp_path / "there"))
    assert torch.equal(before.frames[1].image, after.frames[1].image)
    returns, rounded = (
        np.fromfile(folder / "lidar" / "001.bin", np.float32) for folder in (street, tmp_path / "there")
    )
    assert 0 < np.abs(returns - rounded).max() <= 2.0**-11
    assert make_street(TINY, tmp_path / "there") == tmp_path / "there"  # it is that street: nothing is traced
    assert "MiB  in all, of at most 55" in capsys.readouterr().out


@pytest.mark.lengthy
def test_what_is_too_large_or_no_street_does_not_travel(tmp_path, packing, street):
    packing["pack"].__globals__["MOST"] = 1000
    with pytest.raises(ValueError, match="too large to travel"):
        packed(packing, street=street, out=tmp_path / "gpu")
    with pytest.raises(ValueError, match=r"no street\.json"):
        packed(packing, street=tmp_path, out=tmp_path / "gpu2")
    other = shutil.copytree(street, tmp_path / "other")
    label = json.loads((other / "street.json").read_text())
    label["settings"]["lidar"]["beams"] = 7
    (other / "street.json").write_text(json.dumps(label))
    with pytest.raises(ValueError, match="a lidar of its own"):
        packed(packing, street=other, out=tmp_path / "gpu3")


def test_sources_of_gsplat_get_the_math_of_the_wheel(tmp_path, packing):
    package = tmp_path / "sources" / "gsplat-1.6.0" / "gsplat" / "cuda"
    package.mkdir(parents=True)
    (package / "_backend.py").write_text("newer")
    with pytest.raises(ValueError, match="lack glm"):
        packing["pack_sources"](tmp_path / "sources", tmp_path)
    (tmp_path / "wheels").mkdir()
    with zipfile.ZipFile(tmp_path / "wheels" / "gsplat-1.5.3-py3-none-any.whl", "w") as wheel:
        wheel.writestr("gsplat/cuda/_backend.py", "older")
        wheel.writestr("gsplat/cuda/csrc/third_party/glm/glm/glm.hpp", "math")
    packing["pack_sources"](tmp_path / "sources", tmp_path)
    with tarfile.open(tmp_path / "gsplat.tar.gz") as archive:
        archive.extractall(tmp_path / "site", filter="data")
    assert (tmp_path / "site" / "gsplat" / "cuda" / "_backend.py").read_text() == "newer"
    assert (tmp_path / "site/gsplat/cuda/csrc/third_party/glm/glm/glm.hpp").read_text() == "math"
    with pytest.raises(ValueError, match=r"holds no gsplat/cuda/_backend\.py"):
        packing["pack_sources"](tmp_path / "wheels", tmp_path)


PRETENDS = """
import os, sys, time
from pathlib import Path

given, folder = " ".join(sys.argv[1:]), Path(__file__).parent
out = [Path(word.removeprefix("out=")) for word in sys.argv if word.startswith("out=")]


def call(name):
    with (folder / "calls").open("a") as file:
        file.write(f"{name}: {given}\\n")


if "gpu_says.py machine" in given:
    print("a device", "9.0", "/a/library.so", sep="\\n")
elif "gsplat.cuda._backend" in given:
    print("compiled: True")
elif "-m tarfile" in given:
    call("unpacked")
elif "-m pytest" in given:
    call("parity")
    print("FAILED tests/ops/test_it.py::test_this - it is so\\n1 failed, 2 passed in 3 s")
    sys.exit(1)
elif " bench step " in given:
    call("replay" if "replay=true" in given else "step")
    print("a step 5.00 ms")
elif "gpu_capture.py" in given:
    call("graph")
elif "-m benchmarks.gpu" in given:
    call("theirs" if "first=gsplat" in given else "street" if "runs/plain" in given else "ours")
elif "-m benchmarks.streets" in given:
    call("frames")
elif " train " in given:
    call("pruned" if "resume=" in given else "train")
    for name in ("scene.safetensors", "records/summary.json", "checkpoints/before_0.93334.ckpt"):
        path = out[0] / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    if "resume=" not in given and MODE == "long":
        path.with_name("interrupted.ckpt").write_text("")
        sys.exit(124)
elif " export " in given:
    call("export")
    Path(sys.argv[-1]).write_bytes(bytes(16 * 2**20))
"""
FIRST = ["unpacked", "parity", "step", "graph", "replay", "ours", "theirs", "frames", "train", "export"]
SECOND = ["train", "pruned", "frames", "street", "export", "export"]


def run_call(folder: Path, call: str, mode: str = "quick") -> tuple[dict[str, str], list[str], int]:
    """A call with a Python that notes what it is asked: parts and their states, calls, status."""
    python = folder / "python"
    python.write_text(f"#!{sys.executable} -S\nMODE = {mode!r}\n{PRETENDS}", encoding="utf-8")
    python.chmod(0o755)
    (folder / "calls").unlink(missing_ok=True)
    given = {"PYTHON": python, "PACK": folder / "pack", "STAY": folder / "stay", "OUT": folder / "home"}
    said = subprocess.run(
        [SCRIPTS / "gpu_quarter.sh", call],
        env={"PATH": os.environ["PATH"]} | {name: str(value) for name, value in given.items()},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = (folder / "stay" / call / "table.txt").read_text(encoding="utf-8").splitlines()
    states = {line[:8].strip(): line[9:17].strip() for line in lines if line[25:26] == "s"}
    return states, (folder / "calls").read_text(encoding="utf-8").splitlines(), said.returncode


@pytest.fixture
def pack(tmp_path) -> Path:
    """A folder with what travels, empty."""
    folder = tmp_path / "pack"
    folder.mkdir()
    for name in ("plain.street", "pruned.street", "street.tar.xz"):
        (folder / name).touch()
    (folder / "street.options").write_text("seed=3\ndata.log.settings.width=64\n")
    return folder


@pytest.mark.lengthy
def test_both_calls_in_their_order_and_what_comes_home(tmp_path, pack):
    states, calls, status = run_call(tmp_path, "first", "long")
    assert [call.split(":")[0] for call in calls] == FIRST
    assert (states["parity"], states["train"], status) == ("failed", "stopped", 1)
    assert {states[part] for part in ("step", "graph", "replay", "ours", "theirs", "frames", "export")} == {"ok"}
    begun = next(call for call in calls if call.startswith("train"))
    for word in ("seed=3", "data.log.settings.width=64", "trainer=gpu", "schedule=paper", "branch_points=[0.93334]"):
        assert f" {word}" in begun
    with tarfile.open(tmp_path / "home" / "first.tar.gz") as archive:
        names = archive.getnames()
    assert {"first/table.txt", "first/step.log", "runs/plain/records/summary.json"} <= set(names)
    assert not [name for name in names if "checkpoints" in name or "scene" in name]
    assert {path.name: path.stat().st_size for path in (tmp_path / "home").glob("plain*")} == {
        "plain.street.00": 15 * 2**20, "plain.street.01": 2**20,
    }  # fmt: skip
    # The same machine, warm: the training goes on by the same command, and is pruned from its branch.
    states, calls, status = run_call(tmp_path, "second")
    assert [call.split(":")[0] for call in calls] == SECOND
    assert calls[0] == begun
    assert f"resume={tmp_path}/stay/runs/plain/checkpoints/before_0.93334.ckpt sparsify=importance" in calls[1]
    assert (set(states.values()) - {"skipped"}, status) == ({"ok"}, 0)
    assert len(list((tmp_path / "home").iterdir())) == 6  # of eight that come home


@pytest.mark.lengthy
def test_on_a_bare_machine_the_second_call_trains_what_fits(tmp_path, pack):
    for name in ("plain.street", "pruned.street"):
        (pack / name).unlink()
    _, calls, _ = run_call(tmp_path, "second")
    assert [call.split(":")[0] for call in calls] == ["unpacked", *SECOND]
    minutes = int(calls[1].split("budget.minutes=")[1].split()[0])
    assert 5 <= minutes <= 7
    states, *_ = run_call(tmp_path, "first")
    assert (states["ours"], states["theirs"], states["frames"]) == ("skipped",) * 3


def test_other_words_are_refused():
    said = subprocess.run([SCRIPTS / "gpu_quarter.sh", "third"], capture_output=True, text=True, check=False)
    assert (said.returncode, said.stderr.startswith("usage: scripts/gpu_quarter.sh first|second")) == (2, True)


@pytest.mark.lengthy
@pytest.mark.interpreted
def test_the_probe_of_graphs_runs_without_a_device(tmp_path):
    probe = runpy.run_path(str(SCRIPTS / "gpu_capture.py"))
    probe["main"](tmp_path / "graph.jsonl", ((3, 16, 16),), 1)
    answers = [json.loads(line) for line in (tmp_path / "graph.jsonl").read_text().splitlines()]
    assert [answer["case"] for answer in answers] == ["forward", "forward and backward"]
    assert all(answer["equal"] and answer["refused"] is None for answer in answers)


@pytest.mark.slow
def test_a_dry_run_of_both_calls_with_what_travels(tmp_path, packing):
    street = make_street(replace(TINY, num_frames=10), tmp_path / "street")
    run = made_street(tmp_path / "run")
    packed(packing, street=street, plain=run, pruned=run, out=tmp_path / "pack")
    given = {"PYTHON": sys.executable, "PACK": tmp_path / "pack", "STAY": tmp_path / "stay", "OUT": tmp_path / "home"}
    for call, parts in (
        ("first", ("parity", "step", "graph", "replay", "ours", "theirs", "frames", "train", "export")),
        ("second", ("train", "pruned", "frames2", "street", "export", "export2")),
    ):
        environment = os.environ | {name: str(value) for name, value in given.items()}
        said = subprocess.run(
            [SCRIPTS / "gpu_quarter.sh", call, "--dry-run"],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        table = (tmp_path / "stay" / call / "table.txt").read_text(encoding="utf-8").splitlines()
        states = {line[:8].strip(): line[9:17].strip() for line in table if line[25:26] == "s"}
        # So few steps are finished in the first call.
        expected = dict.fromkeys(parts, "ok") | ({"train": "skipped"} if call == "second" else {})
        assert {part: states.get(part) for part in parts} == expected, said.stdout + said.stderr
        assert said.returncode == 0
        assert any(line.startswith("DRY RUN") for line in table)
