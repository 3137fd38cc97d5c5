"""What the pages show is what a reader types: commands are understood, and Python runs."""

import importlib
import re
import shlex
from dataclasses import fields
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from sparsestreet.cli import COMMANDS, MODULES
from sparsestreet.cli.commands.options import OptionError, parse_options
from sparsestreet.cli.config.validate import override_problem, with_effect_keys
from sparsestreet.cli.runs.costs import Assumptions
from sparsestreet.data.drivestudio import DriveStudioReader
from tests.cli.page_commands import RUN_ELSEWHERE, SHOWN, commands_of, elsewhere
from tests.conftest import unchecked
from tests.test_docs import PAGES, ROOT

STAND_INS = {"data=auto": "data=drivestudio", "data=NAME": "data=drivestudio"}
"""The command itself finds the reader of a folder."""
DAILY = ("README.md", "train.md", "gpu.md")
"""Pages whose commands a daily run parses; the others repeat most of them."""
OF_HYDRA = ("train", "jobs", "effects", "demo", "data")


@cache
def problem_of(command: str) -> str | None:
    """Why a command cannot be followed; it is parsed or composed, and does nothing."""
    name, *words = shlex.split(command)[1:]
    words = [STAND_INS.get(word, re.sub("=N$", "=3", word)) for word in words]
    if name not in COMMANDS:
        return "there is no such command"
    # Options of one's own are tested in test_extending.py; without words a command says how it is used.
    if not words or {"--help", "resume=RUN"} & set(words) or any("searchpath" in word for word in words):
        return None
    if name in OF_HYDRA:
        own = ("from=", "to=", "layout", "jpeg_quality=", "flavor=", "model=", "classes=")
        own += tuple(f"{one.name}=" for one in fields(Assumptions)) if name == "jobs" else ()
        words = [word for word in words if not word.startswith(own)]
        words = [word for word in words if "=" in word or word.startswith("-")] if name == "data" else words
        several = ["-m"] if any(word.startswith("+sweep=") for word in words) else []
        return override_problem(with_effect_keys([*several, *words]))
    module = importlib.import_module(f"sparsestreet.cli.commands.{MODULES.get(name, name)}")
    with pytest.MonkeyPatch.context() as patch:
        return _bench_problem(module, words, patch) if name == "bench" else _option_problem(module, name, words, patch)


def _option_problem(module: ModuleType, name: str, words: list[str], patch: pytest.MonkeyPatch) -> str | None:
    said: list[str] = []

    def parse(name, usage, words, kind, action, positional=()):
        try:
            parse_options(words, kind, positional)
        except OptionError as error:
            said.append(str(error))
        return 0

    patch.setattr(module, "run_command", parse)
    getattr(module, name)(words)
    return said[0] if said else None


def _bench_problem(module: ModuleType, words: list[str], patch: pytest.MonkeyPatch) -> str | None:
    patch.setattr(torch, "set_num_threads", lambda number: None)
    for mode in re.findall(r'": (_\w+),$', Path(module.__file__ or "").read_text(), flags=re.M):
        patch.setattr(module, mode, lambda options: True)
    try:
        assert module.bench(words) == 0
    except SystemExit:
        return "bench does not take these words"
    return None


@pytest.mark.parametrize(
    "page",
    [page if page.name in DAILY else pytest.param(page, marks=pytest.mark.slow) for page in PAGES],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_every_command_is_understood(page):
    problems = {command: problem_of(command) for command in commands_of(page)}
    assert {command: problem for command, problem in problems.items() if problem is not None} == {}


def test_every_target_of_make_is_there():
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), flags=re.M)
    named = {name for page in PAGES for name in re.findall(r"(?:^|`)make ([\w-]+)", page.read_text(), flags=re.M)}
    assert named <= set(targets)


def test_what_does_not_run_in_the_test_of_all_commands_has_a_test_of_its_own():
    """And each reason is needed by a command."""
    assert [file for _, _, file in RUN_ELSEWHERE if not (ROOT / file).is_file()] == []
    needed = {reason for one in SHOWN if (reason := elsewhere(one))}
    assert needed == {(why, file) for _, why, file in RUN_ELSEWHERE}


def python_of(name: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(), flags=re.S)


def test_the_page_of_python_renders_edits_and_drives(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "RUN").symlink_to(finished)
    with unchecked():
        exec("".join(python_of("docs/python.md")[:-1]), {})
    shapes, error, changed, seen = capsys.readouterr().out.splitlines()[-4:]
    assert shapes.startswith("torch.Size([")
    assert 0 < float(error[7:-1]) < 1
    assert changed.startswith("[")
    assert seen.endswith("uint8")


def test_messages_of_the_page_on_troubleshooting_are_those_of_the_program():
    text = (ROOT / "docs" / "troubleshooting.md").read_text().partition("## What a picture shows")[0]
    messages = re.findall(r"^\| `([^`]+)` \|", text, flags=re.M)
    assert len(messages) > 20
    # A literal may go on in the next line of the source.
    source = re.sub(r'"\s*\n\s*f?"', "", "".join(path.read_text() for path in (ROOT / "sparsestreet").rglob("*.py")))
    source = re.sub(r"\{[^{}\n]*\}|%s|%\.1f", "{}", source)
    for message in messages:
        for part in re.split(r"\b(?:NAME|N)\b", message):
            assert part.strip(" ;,:") in source, message


@pytest.mark.filterwarnings("ignore:The number of training batches")
@pytest.mark.parametrize("page", ["README.md", pytest.param("docs/python.md", marks=pytest.mark.slow)])
def test_the_lines_of_python_train_a_street(page, tiny_street, tmp_path, monkeypatch, capsys):
    """The last of a page, on the street of the other tests, since tracing one takes seconds."""
    monkeypatch.chdir(tmp_path)
    (root,) = (word.partition("=")[2] for word in tiny_street if word.startswith("data.log.root="))
    code, streets = re.subn(
        r"StreetReader\(StreetSettings\(.*?\)\)", f"DriveStudioReader({root!r})", python_of(page)[-1]
    )
    code, trainings = re.subn("max_steps=200", "max_steps=5", code)
    assert (streets, trainings) == (1, 1)
    names: dict[str, Any] = {"DriveStudioReader": DriveStudioReader}
    with unchecked():
        exec(code, names)
    if page == "README.md":
        assert sum(bool(line) for line in code.splitlines()) == 12
        assert names["image"].shape == (40, 64, 3)
        assert 0 < float(names["image"].mean()) < 1
        assert (tmp_path / "mine" / "scene.safetensors").is_file()
    else:
        assert "'background': 5000" in capsys.readouterr().out
