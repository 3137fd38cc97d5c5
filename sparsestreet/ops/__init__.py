"""The splat op: one signature, a dense reference, a fast CPU backend and a Triton one."""

from sparsestreet.ops.backend import resolve_backend
from sparsestreet.ops.guards import Guards, guards
from sparsestreet.ops.raster import PairLimitError
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import contribution, leave_one_out, splat

__all__ = [
    "Guards",
    "PairLimitError",
    "SplatSettings",
    "contribution",
    "guards",
    "leave_one_out",
    "resolve_backend",
    "splat",
]
