"""The splat op: one signature, a dense reference and a fast CPU backend."""

from sparsestreet.ops.backend import resolve_backend
from sparsestreet.ops.cpu.rasteriser import PairLimitError
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import contribution, removal, splat

__all__ = ["PairLimitError", "SplatSettings", "contribution", "removal", "resolve_backend", "splat"]
