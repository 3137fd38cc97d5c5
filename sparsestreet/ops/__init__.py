"""The splat op: one signature, a dense reference, a fast CPU backend and a Triton one. In reading order:

1. the signature: Gaussians and a camera in, a differentiable Rendering out (``splat``), its knobs (``settings``), what
   it demands of its inputs (``validate``), which rows it does not draw (``guards``), and that it is not compiled
   (``disable_compile``);
2. the backends: which one runs (``backend``), what each hands back (``raster``), the truth (``reference``), C++
   (``cpu``), GPUs (``triton``); ``spherical_harmonics`` is the formula that all of them follow;
3. steps around it, in torch and as one fused kernel (``fused`` chooses): from the rows of all nodes to Gaussians
   (``activate``), where boxes are (``poses``), the sky behind the splats (``sky``; its geometry is in ``cube_map``),
   D-SSIM (``ssim``, its window in ``ssim_window``) and Adam of the rows that were seen (``visible_adam``).
"""

from sparsestreet.ops.backend import resolve_backend
from sparsestreet.ops.guards import Guards, guards
from sparsestreet.ops.raster import PairLimitError
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.sky import over_sky
from sparsestreet.ops.splat import contribution, leave_one_out, splat

__all__ = [
    "Guards",
    "PairLimitError",
    "SplatSettings",
    "contribution",
    "guards",
    "leave_one_out",
    "over_sky",
    "resolve_backend",
    "splat",
]
