"""Memory that this process may still take."""

from dataclasses import dataclass
from pathlib import Path

_SYSTEM = Path("/proc/meminfo")
_OWN_GROUPS = Path("/proc/self/cgroup")


@dataclass(frozen=True)
class _Groups:
    """Where Linux keeps the limits of groups of processes, such as the jobs of SLURM: Control Group v2, or v1."""

    prefix: str
    """Of the line of ``_OWN_GROUPS`` with this process's group."""
    root: Path
    limit: str
    used: str
    files: str
    """Entry of memory.stat: bytes of files that the system remembers, and forgets where memory is asked for."""


_V2 = _Groups("0::", Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file")
_V1 = _Groups(
    "memory:", Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
)


def free_bytes() -> int | None:
    """Bytes that the machine, and the job or container that this process belongs to, have free; files that the system
    remembers count as free. None: the system does not tell (it is not Linux)."""
    try:
        free = 1024 * _entries(_SYSTEM)["MemAvailable:"]
    except (OSError, KeyError):
        return None
    return min([free, *_free_of(_V2), *_free_of(_V1)])


def _free_of(groups: _Groups) -> list[int]:
    """Of each group with a limit that holds this process; none where the system has no such groups."""
    try:
        lines = _OWN_GROUPS.read_text().splitlines()
    except OSError:
        return []
    own = [line.partition(groups.prefix)[2] for line in lines if groups.prefix in line]
    # In a container the path may be that of the host: the root is then its own group.
    inner = groups.root / own[0].lstrip("/") if own else groups.root
    found = [_free_of_group(groups, at) for at in (inner, *inner.parents) if at.is_relative_to(groups.root)]
    return [free for free in found if free is not None]


def _free_of_group(groups: _Groups, at: Path) -> int | None:
    try:
        limit = (at / groups.limit).read_text().strip()
        if limit == "max":
            return None
        used = int((at / groups.used).read_text())
        return max(int(limit) - used + _entries(at / "memory.stat")[groups.files], 0)
    except (OSError, KeyError, ValueError):
        return None


def _entries(path: Path) -> dict[str, int]:
    """Name -> number, of a file with one of each a line."""
    return {name: int(number) for name, number, *_ in map(str.split, path.read_text().splitlines())}
