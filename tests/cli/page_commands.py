"""The commands that the pages show, and what stands in for them so that each runs in seconds."""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from tests.test_docs import EVERY_PAGE

PREFIX = re.compile(r"^(?:\w+=\S+ )*(?:\.venv/bin/|torchrun .*--no-python |srun (?:-\S+ )*)?(?=sparsestreet )")


def commands_of(page: Path) -> list[str]:
    """Commands in blocks and within sentences, without what a page leaves open: [...], ... and names in capitals."""
    text = page.read_text()
    blocks = [block for kind, block in re.findall(r"^```([^\n]*)\n(.*?)^```", text, flags=re.S | re.M) if kind == ""]
    blocks += re.findall(r"(?:^ {4}.*\n)+", text, flags=re.M)
    lines = [line.strip() for block in blocks for line in re.sub(r"\\\n\s*", "", block).splitlines()]
    lines += [" ".join(line.split()) for line in re.findall(r"`(sparsestreet [^`]*)`", text)]
    lines = [re.split(r"\s+#|\s{3,}(?=[a-zL])", PREFIX.sub("", line))[0] for line in lines]
    found = [re.sub(r" \[.*?\](?= |$)", "", line) for line in lines if line.startswith("sparsestreet ")]
    return [line for line in found if "..." not in line and "COMMAND" not in line]


SHOWN = list(
    dict.fromkeys(command for page in EVERY_PAGE if page.name != "CHANGELOG.md" for command in commands_of(page))
)
"""Of all pages, each once."""
NAMES = ("data check", "render", "serve", "jobs", "report")
"""In a sentence these stand for the command; alone they only say how it is used."""

RUN_ELSEWHERE = (
    # What a command has, why it does not run here, and the tests of its kind.
    (r"demo$", "three trainings of the command train, which are replaced there", "tests/cli/test_demo.py"),
    (r"train resume=RUN", "needs a run that was interrupted", "tests/cli/test_resume.py"),
    (r"hydra/launcher=joblib", "starts processes", "tests/cli/test_killed_sweep.py"),
    (r"hydra/launcher=submitit", "needs a cluster", "tests/cli/test_submitit.py"),
    (r"trainer=ddp", "starts processes", "tests/training/parallel/test_several.py"),
    (r"train \+sweep=(?!tiny|NAME)", "takes hours; every job is composed", "tests/cli/test_sweep.py"),
    (r"data masks ", "needs a segmenter", "tests/cli/test_masks.py"),
    (r"hydra\.searchpath", "needs files of the reader's own", "tests/cli/test_extending.py"),
)

STAND_INS = {
    "data=NAME": "data=drivestudio",
    "method=M": "method=streetgs",
    "+sweep=NAME": "+sweep=tiny",
    "sweep=outputs/sweeps/NAME": "sweep=outputs/sweeps/tiny",
    "seed=N": "seed=0",
    "seed=0,1,2": "seed=0",
    "budget.minutes=N": "budget.minutes=1",
    "FILE": "file.mp4",
    # Names of recorded drives, and those of the drives that tests write.
    "data.log.scene=2b044433": "data.log.scene=7f00aaaa",
    "data.log.scene=SEGMENT": "data.log.scene=drive",
    "data.log.drive=2011_09_26_drive_0001": "data.log.drive=2011_09_26_drive_0099",
    "data.log.first_frame=100": "data.log.first_frame=0",
    "data.log.last_frame=200": "data.log.last_frame=5",
    "data.log.width=960": "data.log.width=16",
    "split.offset=50": "split.offset=5",
}
"""A word of the pages, and what stands in for it."""


def words_of(command: str) -> list[str]:
    """Those behind ``sparsestreet``, with what the pages leave open filled in; on the CPU, on one thread."""
    alike = re.sub(r" trainer=gpu| --threads \d+", "", command)
    return [STAND_INS.get(word, word) for word in shlex.split(alike)[1:]]


def elsewhere(command: str) -> tuple[str, str] | None:
    """Why a command does not run in ``test_pages_run.py``, and the file of tests that has its kind."""
    return next(((why, file) for pattern, why, file in RUN_ELSEWHERE if re.search(pattern, command)), None)


def reader_of(words: Sequence[str]) -> str:
    """The data set that a command names: DriveStudio's layout where the files tell."""
    named = [word.partition("=")[2] for word in words if word.startswith("data=")]
    return "drivestudio" if not named or named[0] == "auto" else named[0]
