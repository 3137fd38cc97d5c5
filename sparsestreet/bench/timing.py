"""Repeated timings of the op and their spread."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sparsestreet.ops.cpu.library import FASTEST_VARIANT, Workspace, idle_workspaces
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import splat
from sparsestreet.phases import clock_of
from sparsestreet.types import Camera, Gaussians

GROUPS = ("means", "quaternions", "scales", "opacities", "sh")
"""The fields of Gaussians that get a gradient."""


@dataclass(frozen=True)
class TimeSpread:
    """Milliseconds of repeated runs."""

    median: float
    minimum: float
    iqr: float | None
    """Third quartile less the first; None for a single run."""
    repeats: int

    def __str__(self) -> str:
        spread = "" if self.iqr is None else f" (iqr {self.iqr:.2f})"
        return f"{self.median:9.2f} ms, least {self.minimum:.2f}{spread}"


def spread(seconds: Sequence[float]) -> TimeSpread:
    """Median, minimum and inter-quartile range (linear between samples)."""
    milliseconds = [1e3 * value for value in seconds]
    iqr = None
    if len(milliseconds) > 1:
        first, _, third = statistics.quantiles(milliseconds, n=4, method="inclusive")
        iqr = third - first
    return TimeSpread(statistics.median(milliseconds), min(milliseconds), iqr, len(milliseconds))


@dataclass(frozen=True)
class TimingBudget:
    """How long to repeat: ``repeats`` runs, fewer once ``seconds`` are spent, but never fewer than ``least``."""

    repeats: int = 20
    seconds: float = 10.0
    least: int = 3

    def warm_up(self, run: Callable[[], None]) -> None:
        """Run twice, or once if that takes long, without counting: buffers grow, code is compiled."""
        start = time.perf_counter()
        run()
        if time.perf_counter() - start < self.seconds / self.least:
            run()

    def runs(self, run: Callable[[], None]) -> None:
        """Call ``run`` as often as the budget allows."""
        start = time.perf_counter()
        for done in range(self.repeats):
            if done >= self.least and time.perf_counter() - start > self.seconds:
                return
            run()


ONCE = TimingBudget(repeats=2, least=1)
"""Enough to see that something runs."""


@dataclass(frozen=True)
class Cotangent:
    """A fixed random upstream gradient of color and alpha; alpha's part reveals errors of the transmittance."""

    rgb: Tensor
    alpha: Tensor

    @staticmethod
    def of(camera: Camera, like: Tensor) -> "Cotangent":
        """Draw standard normal numbers, in float64 so that every dtype and device gets the same."""
        generator = torch.Generator().manual_seed(1)
        values = torch.randn(camera.height, camera.width, 4, generator=generator, dtype=torch.float64).to(like)
        return Cotangent(values[..., :3].contiguous(), values[..., 3].contiguous())

    def backward(self, rgb: Tensor, alpha: Tensor) -> None:
        """Differentiates the sum of the products with color and alpha."""
        torch.autograd.backward([rgb, alpha], [self.rgb, self.alpha])


@dataclass(frozen=True)
class OpTimes:
    """Times of each stage and of the whole op, and the work of its forward pass (None for the dense reference)."""

    stages: dict[str, TimeSpread]
    """``forward`` and ``backward`` of the whole op, and the stages that the backend reports."""
    pairs: int | None
    samples: int | None


def leaves(gaussians: Gaussians, dtype: torch.dtype, device: str | torch.device = "cpu") -> Gaussians:
    """A copy in this dtype on this device whose fields collect gradients."""
    columns = gaussians.columns().items()
    copies = {name: column.detach().to(device, dtype, copy=True).requires_grad_() for name, column in columns}
    moved = gaussians.displacements
    return replace(gaussians, **copies, displacements=None if moved is None else moved.to(device, dtype))


def on_device(camera: Camera, device: str | torch.device) -> Camera:
    """The camera with its matrices on the device, for peers that need them there (ours reads them on the host)."""
    return replace(
        camera, camera_from_world=camera.camera_from_world.to(device), intrinsics=camera.intrinsics.to(device)
    )


def time_op(
    gaussians: Gaussians, camera: Camera, settings: SplatSettings, backend: str, budget: TimingBudget
) -> OpTimes:
    """Times repeated forward and backward passes of the op on rows that are ``leaves``."""
    cotangent = Cotangent.of(camera, gaussians.means)
    seconds: dict[str, list[float]] = {}

    def draw(rows: Gaussians) -> tuple[Tensor, Tensor]:
        rendering = splat(rows, camera, settings=settings, backend=backend)
        return rendering.rgb, rendering.alpha

    def run() -> None:
        times = time_once(draw, cotangent, gaussians)
        for name, value in (times | stage_seconds(gaussians, backend)).items():
            seconds.setdefault(name, []).append(value)

    budget.warm_up(run)
    seconds.clear()
    budget.runs(run)
    pairs, samples = work_of(gaussians, camera, settings, backend)
    return OpTimes({name: spread(values) for name, values in seconds.items()}, pairs, samples)


Draw = Callable[[Gaussians], tuple[Tensor, Tensor]]
"""Color and alpha of one view, differentiable."""


def time_once(draw: Draw, cotangent: Cotangent, gaussians: Gaussians) -> dict[str, float]:
    """Seconds of one forward and one backward pass; gradients are dropped afterwards."""
    clock = clock_of(gaussians.means.device)
    start = clock.mark()
    rgb, alpha = draw(gaussians)
    middle = clock.mark()
    cotangent.backward(rgb, alpha)
    end = clock.mark()
    drop_gradients(gaussians)
    return {"forward": clock.seconds(start, middle), "backward": clock.seconds(middle, end)}


def drop_gradients(gaussians: Gaussians) -> None:
    """Drops the gradients that leaves have collected."""
    for name in GROUPS:
        getattr(gaussians, name).grad = None


def stage_seconds(gaussians: Gaussians, backend: str) -> dict[str, float]:
    """Seconds of the stages of the last forward and backward pass; empty if the backend does not time them."""
    if backend != "cpu":
        return {}
    stages = last_workspace(gaussians.means.dtype).stage_seconds()
    return {name: value for name, value in stages.items() if name != "count"}


def work_of(
    gaussians: Gaussians, camera: Camera, settings: SplatSettings, backend: str
) -> tuple[int | None, int | None]:
    """(splat, tile) pairs and evaluated (splat, pixel) samples of a forward pass; None for the dense reference."""
    if backend == "reference":
        return None, None
    if backend == "triton":
        from sparsestreet.ops.triton.counters import count_work  # Triton is imported only where it is used

        return count_work(gaussians, camera, settings)
    with torch.no_grad():
        splat(gaussians, camera, settings=settings, backend=backend)
    workspace = last_workspace(gaussians.means.dtype)
    return workspace.pair_count(), workspace.sample_count()


def last_workspace(dtype: torch.dtype) -> Workspace:
    """The workspace of the C++ rendering whose graph was dropped last."""
    return [workspace for workspace in idle_workspaces() if workspace.key == (dtype, FASTEST_VARIANT)][-1]
