"""How a folder shows whose data set it holds: by files that only that one has."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Marks:
    """Files or folders of a data set, as patterns below its root; any one of them tells."""

    patterns: Sequence[str]
    depth: int = 0
    """Folders below the root that may hold them instead."""

    def found_in(self, root: Path) -> Path | None:
        """What tells, below ``root``; None where there is nothing of it."""
        return next((path for found in self._searched(root) if (path := min(found, default=None))), None)

    def tell_of(self, folder: Path, root: Path) -> bool:
        """Whether something below ``root`` that tells is ``folder``, or in it, or around it."""
        every = (path for found in self._searched(root) for path in found)
        return any(path.is_relative_to(folder) or folder.is_relative_to(path) for path in every)

    def _searched(self, root: Path) -> Iterator[Iterator[Path]]:
        for depth in range(self.depth + 1):
            for pattern in self.patterns:
                yield root.glob("*/" * depth + pattern)

    def __str__(self) -> str:
        below = f", up to {self.depth} folders below" if self.depth else ""
        return " or ".join(self.patterns) + below


@dataclass(frozen=True)
class UnreadFormat:
    """A data set that no reader reads."""

    name: str
    marks: Marks
    remedy: str
    """What to do instead."""


UNREAD = (
    UnreadFormat(
        "NVIDIA's PhysicalAI-AV",
        Marks(("*.egomotion*.parquet", "*.chunk_*.parquet"), depth=1),
        "videos and packed point clouds would need a video decoder and DracoPy: write images, poses and points as "
        "data=rig_json, which has NVIDIA's f-theta lens (docs/datasets/rig_json.md)",
    ),
    UnreadFormat(
        "NVIDIA's NCore",
        Marks(("*.zarr.itar",), depth=1),
        "its containers would need the package nvidia-ncore: write what that reads as data=rig_json "
        "(docs/datasets/rig_json.md)",
    ),
)
"""Recognized, so that nobody looks for a mistake of their own."""
