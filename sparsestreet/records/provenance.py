"""The machine and the version of the code that made a run."""

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

from sparsestreet.records.run import CodeVersion, Machine

_PACKAGE = Path(__file__).resolve().parents[1]


def this_machine() -> Machine:
    """Returns processor, cores and software versions; no host or user name."""
    return Machine(
        processor=processor_name(),
        cores=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        torch=metadata.version("torch"),
    )


def processor_name() -> str:
    """Returns the processor's model, or its architecture if the system does not name a model."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def this_source(package: Path = _PACKAGE) -> CodeVersion:
    """Returns the commit of the checkout that holds the package, and whether tracked files differ from it.

    Both are None if git is not installed or no checkout tracks the package. An installed copy inside another
    repository must not carry that repository's commit.
    """
    tracked = _git(package, "ls-files", "--error-unmatch", "__init__.py")
    commit = _git(package, "rev-parse", "HEAD")
    if tracked is None or commit is None:
        return CodeVersion(None, None)
    return CodeVersion(commit, _git(package, "status", "--porcelain", "--untracked-files=no") != "")


def _git(folder: Path, *arguments: str) -> str | None:
    """Returns the output of a git command, or None if git is missing or fails."""
    try:
        answer = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    except (FileNotFoundError, subprocess.CalledProcessError):
        return None
    return answer.stdout.strip()
