"""The splat op: one signature, a dense reference, a fast CPU backend and a Triton one. In reading order:

1. The signature. ``splat`` takes Gaussians and a camera, and returns a differentiable Rendering. ``settings`` holds its
   knobs, ``validate`` checks its inputs, ``guards`` counts the rows that it does not draw.
2. The backends. ``backend`` chooses one, ``raster`` is what each returns. ``reference`` is the truth, ``cpu`` is in
   C++, ``triton`` for GPUs. All follow the formula in ``spherical_harmonics``.
3. Steps around the op, in torch and as fused kernels (``backend`` chooses). ``activate`` turns the rows of all nodes
   into Gaussians, and ``poses`` places boxes. ``sky`` adds the sky behind the splats; its geometry is in ``cube_map``.
   ``ssim`` is D-SSIM (``ssim_window`` its window), ``photometric`` the loss around it, ``pixel_losses`` are those of
   depth and sky. ``statistics`` is what density control sums. ``adam`` steps the rows that were seen, or of all
   parameters those whose gradient is finite.
"""

from sparsestreet.ops.backend import resolve_backend
from sparsestreet.ops.guards import Guards, guards
from sparsestreet.ops.raster import LeaveOneOutSums, PairLimitError
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.sky import over_sky
from sparsestreet.ops.splat import contribution, leave_one_out, median_depth, splat

__all__ = [
    "Guards",
    "LeaveOneOutSums",
    "PairLimitError",
    "SplatSettings",
    "contribution",
    "guards",
    "leave_one_out",
    "median_depth",
    "over_sky",
    "resolve_backend",
    "splat",
]
