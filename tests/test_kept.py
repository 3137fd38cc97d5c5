"""What is kept of a log: found again bit for bit, by all that it depends on, and made anew where it is damaged."""

import logging
import os
import pickle
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sparsestreet import kept
from sparsestreet.data.hood import Hood
from sparsestreet.kept import Kept, code_version
from sparsestreet.scene.initialize.gaussians import Points
from sparsestreet.scene.initialize.sources import LidarPoints
from sparsestreet.types import Track

TRACK = Track("car", "Car", torch.arange(2), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), torch.ones(3))


class Asked:
    """Answers with a value, and counts how often it is asked."""

    def __init__(self, value: object = 7) -> None:
        self.value, self.times = value, 0

    def __call__(self) -> object:
        self.times += 1
        return self.value


def same(one: Any, other: Any) -> bool:
    """Whether two answers are equal to the last bit, and of the same kinds."""
    if type(one) is not type(other):
        return False
    if isinstance(one, torch.Tensor):
        return (
            one.dtype == other.dtype and one.shape == other.shape and one.numpy().tobytes() == other.numpy().tobytes()
        )
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    return same(vars(one), vars(other)) if isinstance(one, Points | Hood) else repr(one) == repr(other)


ANSWERS = {
    "nothing": None,
    "plain": ("a", 3, True, 0.1 + 0.2, float("nan"), float("-inf"), [None, ""], ()),
    "tensors": [torch.rand(2, 3).T, torch.zeros(0, 3), torch.tensor(1.5), torch.arange(3) > 1, torch.full((2,), 9e9)],
    "arrays": {3: np.arange(4)[::2], "": np.zeros((0, 2), np.float32)},
    "dataclasses": {0: Hood(torch.ones(2, 2, dtype=torch.bool), 0.5), 2: Points(torch.rand(2, 3), torch.rand(2, 3))},
}  # fmt: skip


@pytest.mark.parametrize("answer", ANSWERS.values(), ids=ANSWERS)
def test_an_answer_is_found_as_it_was(answer, tmp_path):
    asked = Asked(answer)
    for runs in (1, 1):
        assert same(Kept(tmp_path / "new").get("answer", (), asked, Hood, Points), answer)
        assert asked.times == runs
    assert [path.suffix for path in (tmp_path / "new").iterdir()] == [".npz"]
    assert same(Kept().get("answer", (), asked), answer)  # without a folder
    assert asked.times == 2


@dataclass(frozen=True)
class Foreign:
    """Of a module whose code may change unseen."""

    number: int = 0


SAID = {
    "another name": ("other", (), ()),
    "what was said before": ("answer", ("log",), ()),
    "a number": ("answer", (), 1),
    "a setting": ("answer", (), LidarPoints(voxel=0.1)),
    "another setting": ("answer", (), LidarPoints(voxel=0.2)),
    "a kind of number": ("answer", (), True),
    "a mapping": ("answer", (), {"a": 1}),
    "a mapping's key": ("answer", (), {"b": 1}),
    "a tensor": ("answer", (), torch.zeros(3)),
    "a tensor's value": ("answer", (), torch.tensor([0.0, 0.0, 1e-30])),
    "a tensor's type": ("answer", (), torch.zeros(3, dtype=torch.int32)),
    "a tensor's shape": ("answer", (), torch.zeros(3, 1)),
    "an object": ("answer", (), [TRACK]),
    "a box": ("answer", (), [replace(TRACK, size=2 * TRACK.size)]),
    "frames": ("answer", (), frozenset({1, 2})),
}


def test_whatever_is_said_is_another_file(tmp_path, monkeypatch):
    for name, before, said in SAID.values():
        assert Kept(tmp_path).within(*before).get(name, said, asked := Asked()) == 7
        assert asked.times == 1, (name, before, said)
    assert len(list(tmp_path.iterdir())) == len(SAID)
    for name, before, said in SAID.values():
        Kept(tmp_path, *before).get(name, said, asked := Asked())
        assert asked.times == 0, (name, before, said)
    monkeypatch.setattr(kept, "code_version", lambda: "changed")
    name, before, said = SAID["a box"]
    Kept(tmp_path, *before).get(name, said, asked := Asked())
    assert asked.times == 1


def test_the_version_is_that_of_all_source(tmp_path, monkeypatch):
    source = tmp_path / "sparsestreet" / "data" / "log.py"
    source.parent.mkdir(parents=True)
    monkeypatch.setattr(kept, "__file__", str(tmp_path / "sparsestreet" / "kept.py"))
    versions = []
    for text in ("a = 1", "a = 2", "a = 1"):
        source.write_text(text)
        versions.append(code_version.__wrapped__())
    source.rename(source.with_name("rig.py"))
    versions.append(code_version.__wrapped__())
    assert versions[0] == versions[2]
    assert len(set(versions)) == 3


def test_code_from_outside_is_asked_each_time(tmp_path, caplog):
    asked = Asked()
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            Kept(tmp_path).get("answer", [Foreign()], asked)
    assert asked.times == 2
    assert "answer is not kept for the next run: it depends on tests.test_kept.Foreign" in caplog.text
    assert not list(tmp_path.iterdir())


def _flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[content.index(b"\x77" * 64) + 8] ^= 1  # in the midst of the tensor
    path.write_bytes(bytes(content))


class Harm:
    def __reduce__(self):
        return os._exit, (3,)


def _pickle(path: Path) -> None:
    np.savez(path, tree=np.array(Harm(), dtype=object))


DAMAGE = {
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "flipped": _flipped,
    "a pickle": _pickle,
    "pickled": lambda path: path.write_bytes(pickle.dumps([1])),
    "without its tree": lambda path: np.savez(path, array_0=np.zeros(3)),
    "without an array": lambda path: np.savez(path, tree=np.array('{"tensor": "array_0"}')),
    "of another class": lambda path: np.savez(path, tree=np.array('{"Popen": {"args": "true"}}')),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_file_is_made_anew_and_said_once(damage, tmp_path, caplog):
    answer = torch.full((400,), 0x77, dtype=torch.uint8)
    asked = Asked(answer)
    Kept(tmp_path).get("answer", (), asked)
    (path,) = tmp_path.iterdir()
    sound = path.read_bytes()
    damage(path)
    got = Kept(tmp_path).get("answer", (), asked)
    assert same(got, answer)
    assert asked.times == 2
    (said,) = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert said.startswith(f"{path} is damaged (")
    assert "\n" not in said
    assert path.read_bytes() == sound


def test_a_folder_that_cannot_be_written_is_told_of_before_any_work(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"cannot be written .*: name another place"):
        Kept(tmp_path / "file").get("answer", (), asked := Asked())
    assert asked.times == 0


def test_an_error_or_a_kill_leaves_nothing_that_is_found(tmp_path):
    def fail() -> None:
        raise ValueError("no points")

    with pytest.raises(ValueError, match="no points"):
        Kept(tmp_path).get("answer", (), fail)
    assert not list(tmp_path.iterdir())
    code = (
        "import os, sys; from sparsestreet.kept import Kept; Kept(sys.argv[1]).get('answer', (), lambda: os._exit(9))"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)]).returncode == 9  # the lock is still there
    Kept(tmp_path).get("answer", (), asked := Asked())
    assert asked.times == 1
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]


TWO = """
import sys, time
from sparsestreet.kept import Kept
def make():
    with open(sys.argv[2], "a") as file:
        file.write("x")
    time.sleep(1.0)
    return list(range(5))
print("ready", flush=True)
sys.stdin.readline()
print(Kept(sys.argv[1]).get("answer", (), make))
"""


@pytest.mark.lengthy
def test_of_two_processes_one_computes(tmp_path):
    count = tmp_path / "count"
    words = [sys.executable, "-c", TWO, str(tmp_path / "kept"), str(count)]
    both = [subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    for process in both:
        assert process.stdout.readline() == "ready\n"
    for process in both:
        process.stdin.write("\n")
        process.stdin.flush()
    assert [process.communicate()[0] for process in both] == ["[0, 1, 2, 3, 4]\n"] * 2
    assert count.read_text() == "x"
    assert [path.suffix for path in (tmp_path / "kept").iterdir()] == [".npz"]


def test_what_was_asked_for_longest_ago_makes_room(tmp_path, monkeypatch):
    """What was found lately stays, although it was made first."""
    files = {}
    for number in range(4):
        Kept(tmp_path).get("answer", number, Asked(torch.zeros(1000)))
        (files[number],) = set(tmp_path.iterdir()) - set(files.values())
        os.utime(files[number], ns=(0, 10**9 * number))
    Kept(tmp_path).get("answer", 0, Asked())
    monkeypatch.setattr(kept, "MAX_BYTES", 3 * files[0].stat().st_size)
    Kept(tmp_path).get("answer", 4, Asked(torch.zeros(1000)))
    assert [number for number, path in files.items() if path.exists()] == [0, 3]
    assert len(list(tmp_path.iterdir())) == 3
