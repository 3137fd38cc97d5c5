"""On what and from which code a run was made."""

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

from sparsestreet.records.run import CodeVersion, Machine

_PACKAGE = Path(__file__).resolve().parents[1]


def this_machine() -> Machine:
    """Processor, cores and software versions; no host or user name."""
    return Machine(
        processor=processor_name(),
        cores=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        torch=metadata.version("torch"),
    )


def processor_name() -> str:
    """The processor's model as the system calls it, or its architecture where the system does not say."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def this_source(package: Path = _PACKAGE) -> CodeVersion:
    """Commit of the checkout that holds the package, and whether tracked files differ from it.

    None where the package does not lie in a git checkout as tracked files (an installed copy inside somebody's
    repository must not carry that repository's commit) or git is not installed.
    """
    tracked = _git(package, "ls-files", "--error-unmatch", "__init__.py")
    commit = _git(package, "rev-parse", "HEAD")
    if tracked is None or commit is None:
        return CodeVersion(None, None)
    return CodeVersion(commit, _git(package, "status", "--porcelain", "--untracked-files=no") != "")


def _git(folder: Path, *arguments: str) -> str | None:
    """Output of a git command, None if git is missing or refuses."""
    try:
        answer = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    except (FileNotFoundError, subprocess.CalledProcessError):
        return None
    return answer.stdout.strip()
