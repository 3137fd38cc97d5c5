"""Short runs that are disturbed, and what a command may answer to files that are broken."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from tests.cli.conftest import TIMED_ONCE, TINY_BACKGROUND, TINY_RIGID
from tests.stress.forked import Ended

SHORT = [
    "effects.sky.resolution=8",
    *TINY_BACKGROUND,
    *TINY_RIGID,
    *TIMED_ONCE,
    "schedule.max_steps=20",
    "trainer.val_check_interval=20",
]
"""Two seconds of one core in a process that was forked."""
MORE_MB = 1500
"""Memory that a training may reserve beyond what its process began with: threads reserve most of it, and use little."""


def street_of(tiny_street: Sequence[str]) -> Path:
    """The folder of the street that these overrides select."""
    (root,) = (word.partition("=")[2] for word in tiny_street if word.startswith("data.log.root="))
    return Path(root)


def on_drive(drive: Path, out: Path) -> list[str]:
    """Words that train on a drive in DriveStudio's layout."""
    return ["train", "data=drivestudio", f"data.root={drive}", *SHORT, f"out={out}", f"cache={out}.kept"]


def cut_short(finished: Path, run: Path) -> None:
    """A copy of a run as a kill leaves it half way."""
    shutil.copytree(finished, run)
    for name in ("records", "pictures", "predictions"):
        shutil.rmtree(run / name)
    for name in ("scene.safetensors", "views.json", "rig.json"):
        (run / name).unlink()
    said = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(said | {"steps": said["steps"] // 2}))


def contents(folder: Path) -> dict[str, bytes]:
    """What the files of a folder hold, but for the log and the configuration of each start, and curves, whose file is
    written anew by each start."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in ("train.log", "metrics.csv"))
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if ".hydra" not in path.parts}


def assert_refused(ended: Ended, says: str) -> None:
    """One clear line, or the list of a log's problems; no traceback."""
    said = [line for line in ended.lines if "][INFO]" not in line and line.strip()]
    assert ended.status in (1, 2), ended
    assert "Traceback" not in ended.said, ended.said
    assert says in said[-1], ended.said
    assert len(said) == 1 + (" problem in the log:" in said[0]), ended.said


def assert_survived(ended: Ended, warns: str) -> None:
    """It came to its end, and said so where something was wrong."""
    assert ended.status == 0, ended.said
    assert "Traceback" not in ended.said, ended.said
    assert warns in ended.said


def assert_nothing_half_written(folder: Path) -> None:
    assert [str(path) for path in folder.rglob("*") if ".tmp" in path.name] == []
