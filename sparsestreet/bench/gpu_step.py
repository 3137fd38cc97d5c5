"""A whole training step of 3DGS on one view with either renderer; everything but the renderer is our code.

The step is activation, rendering, L1 and SSIM, backward, Adam over all numbers, and the statistics of density control.
"""

from collections.abc import Callable
from types import ModuleType

import torch
from torch import Tensor

from sparsestreet.bench import gsplat_peer
from sparsestreet.bench.timing import TimeSpread, TimingBudget, on_device, spread
from sparsestreet.ops.splat import splat
from sparsestreet.ops.ssim import ssim
from sparsestreet.phases import clock_of
from sparsestreet.scene.density import DensityStatistics
from sparsestreet.types import Camera, Gaussians

Seen = Callable[[], tuple[Tensor, Tensor]]
"""Absolute screen gradients [n, 2] and radii [n] of a rendering, after its backward pass."""
Render = Callable[[Gaussians], tuple[Tensor, Seen]]

SHARE = 0.2
"""Weight of D-SSIM in the loss (3DGS, eq. 7)."""


def our_render(camera: Camera, backend: str) -> Render:
    """Renders with the op of this project."""

    def render(gaussians: Gaussians) -> tuple[Tensor, Seen]:
        rendering = splat(gaussians, camera, settings=gsplat_peer.SETTINGS, backend=backend)
        return rendering.rgb, lambda: (rendering.screen_gradients, rendering.radii)

    return render


def their_render(module: ModuleType, camera: Camera, device: torch.device, mode: str) -> Render:
    """Renders with gsplat in one of its modes."""
    moved = on_device(camera, device)

    def render(gaussians: Gaussians) -> tuple[Tensor, Seen]:
        rgb, meta = gsplat_peer.draw_for_training(module, gaussians, moved, mode)
        return rgb, lambda: gsplat_peer.seen(meta, len(gaussians))

    return render


class TrainingStep:
    """Parameters of a scene with an optimizer, and one step on one target image.

    Args:
        start: the Gaussians that are trained, float32.
        camera: the view; its target is random.
        render: the renderer.
    """

    def __init__(self, start: Gaussians, camera: Camera, render: Render) -> None:
        g = start
        fields = (g.means, g.quaternions, g.scales.log(), g.opacities.clamp(1e-6, 1 - 1e-6).logit(), g.sh)
        self.parameters = [field.detach().clone().requires_grad_() for field in fields]
        self.optimizer = torch.optim.Adam(self.parameters, lr=1e-6, eps=1e-15, fused=g.means.is_cuda)
        generator = torch.Generator().manual_seed(2)
        self.target = torch.rand(camera.height, camera.width, 3, generator=generator).to(g.means)
        self.statistics = DensityStatistics(len(g), g.means.device)
        self.camera, self.render = camera, render

    def __call__(self) -> None:
        means, quaternions, log_scales, logits, sh = self.parameters
        rgb, seen = self.render(Gaussians(means, quaternions, log_scales.exp(), logits.sigmoid(), sh))
        error = (1 - SHARE) * (rgb - self.target).abs().mean() + SHARE * (1 - ssim(rgb, self.target))
        error.backward()
        self.statistics.add(*seen(), self.camera.width, self.camera.height)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)


def step_time(start: Gaussians, camera: Camera, render: Render, budget: TimingBudget) -> TimeSpread:
    """Milliseconds of a step; each step waits for the device."""
    step, clock, seconds = TrainingStep(start, camera, render), clock_of(start.means.device), []

    def run() -> None:
        begin = clock.mark()
        step()
        seconds.append(clock.seconds(begin, clock.mark()))

    budget.warm_up(run)
    seconds.clear()
    budget.runs(run)
    return spread(seconds)
