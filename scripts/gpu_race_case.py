"""One small rendering with its gradients, for a tool that watches memory: python scripts/gpu_race_case.py CASE.

CASE: "plain" (a pinhole), "lens", "shutter", "both", "gates" (a pinhole, rows with gates). Without a CUDA device
it needs TRITON_INTERPRET=1.
"""

import sys
from dataclasses import replace

import torch

from sparsestreet.ops import splat
from sparsestreet.types import Camera, Gaussians, Shutter

CASES = ("plain", "lens", "shutter", "both", "gates")
ROWS = 140
"""More than a program of either kind of camera has, and no multiple of its rows."""


def camera_of(case: str) -> Camera:
    """A camera at the origin that looks along z."""
    intrinsics = torch.tensor([[24.0, 0.0, 12.0], [0.0, 24.0, 8.0], [0.0, 0.0, 1.0]])
    camera = Camera(torch.eye(4), intrinsics, width=24, height=16)
    if case in ("lens", "both"):
        camera = replace(camera, distortion=torch.tensor([0.1, 0.01, 0.0, 0.0, 0.0]))
    if case in ("shutter", "both"):
        camera = replace(camera, shutter=Shutter(torch.full((3,), 0.01), torch.zeros(3)))
    return camera


def main(case: str) -> None:
    """Renders and differentiates; raises ValueError for an unknown case."""
    if case not in CASES:
        raise ValueError(f"the case must be one of {', '.join(CASES)}, got {case!r}")
    device, generator = "cuda" if torch.cuda.is_available() else "cpu", torch.Generator().manual_seed(0)

    def numbers(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator).to(device).requires_grad_()

    means = torch.rand(ROWS, 3, generator=generator) + torch.tensor([-0.5, -0.5, 2.0])
    fields = (means.to(device).requires_grad_(), numbers(ROWS, 4), numbers(ROWS, 3), numbers(ROWS), numbers(ROWS, 4, 3))
    # Splats that do not cover the whole image.
    scaled = replace(Gaussians(*fields), scales=0.05 * fields[2])
    gates = numbers(ROWS) if case == "gates" else None
    rendering = splat(scaled, camera_of(case), backend="triton", gates=gates)
    (rendering.rgb.sum() + rendering.depth.sum()).backward()
    learned = fields if gates is None else (*fields, gates)
    finite = all(bool(field.grad is not None and field.grad.isfinite().all()) for field in learned)
    print(f"{case}: {int(rendering.visible.sum())} of {ROWS} rows drawn, gradients finite: {finite}")


if __name__ == "__main__":
    main(*sys.argv[1:])
