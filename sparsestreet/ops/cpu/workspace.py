"""Memory of the C++ library: one workspace serves a rendering from forward to backward, then the next one."""

import itertools

import torch

from sparsestreet.ops.cpu.library import STAGES, load_library

FASTEST_VARIANT = -1
_KEPT_IDLE = 2
_idle: dict[tuple[torch.dtype, int], list["Workspace"]] = {}
_uses = itertools.count()


class Workspace:
    """A handle to the library's buffers for one dtype and one instruction-set variant.

    Raises MemoryError if it cannot be made (or the variant does not run on this machine).
    """

    def __init__(self, dtype: torch.dtype, variant: int) -> None:
        self._library = load_library()
        self.key = (dtype, variant)
        self.last_use = 0
        self.handle = self._library.splat_create(int(dtype == torch.float64), variant)
        if not self.handle:
            raise MemoryError(
                f"no splat workspace for {dtype} and variant {variant}: out of memory, or no such variant"
            )

    def stage_seconds(self) -> dict[str, float]:
        """Wall time of each stage that ran last in this workspace."""
        seconds = self._library.splat_stage_seconds(self.handle)
        return {name: seconds[index] for index, name in enumerate(STAGES)}

    def pair_count(self) -> int:
        """(splat, tile) pairs of the last forward pass."""
        return self._library.splat_pair_count(self.handle)

    def sample_count(self) -> int:
        """(splat, pixel) samples that the last forward pass evaluated."""
        return self._library.splat_sample_count(self.handle)

    def poison(self) -> None:
        """Fill all buffers with NaN (tests: nothing may be read before it is written)."""
        self._library.splat_poison(self.handle)

    def __del__(self) -> None:
        if getattr(self, "handle", None):
            self._library.splat_destroy(self.handle)
            self.handle = None


class Lease:
    """A workspace on loan. It becomes idle again when the last reference to the lease is gone."""

    def __init__(self, dtype: torch.dtype, variant: int) -> None:
        idle = _idle.setdefault((dtype, variant), [])
        try:
            self.workspace = idle.pop()
        except IndexError:
            self.workspace = Workspace(dtype, variant)

    def __del__(self) -> None:
        workspace = getattr(self, "workspace", None)
        # If both are garbage of one cycle (an error's traceback), the workspace may be collected first.
        if workspace is None or not workspace.handle:
            return
        workspace.last_use = next(_uses)
        idle = _idle[workspace.key]
        if len(idle) < _KEPT_IDLE:
            idle.append(workspace)


def idle_workspaces() -> list[Workspace]:
    """Workspaces that wait for the next rendering, the most recently used one last."""
    waiting = [workspace for same_key in _idle.values() for workspace in same_key]
    return sorted(waiting, key=lambda workspace: workspace.last_use)
