"""Floors: the least memory traffic and arithmetic of each phase of a training step.

Bytes count everything that must be read or written once, in float32, without caches. Operations are those of the
formula. A phase at its floor keeps memory or arithmetic units busy all the time.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean

import torch

from sparsestreet.bench.blend import BACKWARD_FLOPS, FORWARD_FLOPS
from sparsestreet.ops.ssim_window import WINDOW
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.training.system import StreetSystem

NUMBER = 4.0
"""Bytes of a float32."""
_SHAPE_NUMBERS = 11
"""Numbers of a row's mean, quaternion, scales and opacity."""


@dataclass(frozen=True)
class Floor:
    """Bytes and floating point operations."""

    bytes: float
    flops: float = 0.0

    def seconds(self, bandwidth: float, peak: float) -> float:
        """Seconds at these bytes and operations per second: the larger of the two, as if they overlapped."""
        return max(self.bytes / bandwidth, self.flops / peak)


@dataclass(frozen=True)
class StepWork:
    """The work of one step."""

    rows: int
    visible: int
    """Rows that were drawn."""
    terms: int
    """Coefficients of the spherical harmonics in use."""
    samples: int | None
    """(splat, pixel) samples of the forward pass."""
    parameters: int
    """Numbers that the optimizer steps."""
    size: tuple[int, int]
    """Height and width."""
    sky_pixels: int

    @staticmethod
    def of(system: StreetSystem, rendering: SceneRendering, samples: int | None) -> "StepWork":
        """The work of the last step of the system, which made this rendering."""
        stepped = (value.numel() for value in system.scene.parameters() if value.grad is not None)
        degree = system.state().sh_degree
        seen = 1 - rendering.splats.alpha > system.options.settings.transmittance_min
        return StepWork(
            len(rendering.splats.radii),
            int(rendering.splats.visible.sum()),
            (min(degree, 3) + 1) ** 2,
            samples,
            sum(stepped),
            (rendering.alpha.shape[0], rendering.alpha.shape[1]),
            int(seen.sum()) if "sky" in system.scene.effects else 0,
        )


def floors(work: Sequence[StepWork]) -> dict[str, Floor]:
    """The floor of each phase, averaged over some steps; phases with a negligible floor are left out."""
    steps = [_floors(step) for step in work]
    return {
        name: Floor(mean(step[name].bytes for step in steps), mean(step[name].flops for step in steps))
        for name in (steps[0] if steps else ())
    }


def _floors(work: StepWork) -> dict[str, Floor]:
    pixels, color = work.size[0] * work.size[1], 3 * work.terms
    # Scales, opacity and coefficients are read raw and written activated.
    assembly = Floor(NUMBER * 2 * work.rows * (4 + color))
    read = work.rows * _SHAPE_NUMBERS + work.visible * color
    window_flops = 2 * 2 * WINDOW  # an 11-tap filter along two axes
    found = {
        "scene": assembly,
        "scene backward": assembly,
        "sky": Floor(NUMBER * (pixels + work.sky_pixels * (3 + 3))),
        "sky backward": Floor(NUMBER * work.sky_pixels * (3 + 1 + 3)),
        # Forward takes four means, of sums and differences; backward three derivatives.
        "loss photometric": Floor(NUMBER * 2 * 3 * pixels, 4.0 * window_flops * 3 * pixels),
        "ssim backward": Floor(NUMBER * 3 * 3 * pixels, 3.0 * window_flops * 3 * pixels),
        # Parameter, gradient and two moments are read, all but the gradient written.
        "optimizer": Floor(NUMBER * 7 * work.parameters),
        # Gradient and radius are read; three statistics read and written.
        "density statistics": Floor(NUMBER * work.rows * (3 + 2 * 4)),
    }
    if work.samples is not None:
        found["splat"] = Floor(NUMBER * read, float(FORWARD_FLOPS * work.samples))
        written = work.rows * (_SHAPE_NUMBERS + color + 2)
        found["splat backward"] = Floor(NUMBER * (read + written), float(BACKWARD_FLOPS * work.samples))
    return found


def measured_bandwidth(device: torch.device, megabytes: int = 256) -> float:
    """Bytes per second that an addition in place reads and writes, the best of several.

    It is in place because a copy also reads what it overwrites, which the count of bytes would miss.
    """
    values = torch.zeros(megabytes << 18, device=device)
    seconds = []
    for _ in range(6):
        start = time.perf_counter()
        values.add_(1.0)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - start)
    return 2 * NUMBER * values.numel() / min(seconds)
