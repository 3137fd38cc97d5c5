"""Sparse Gaussian scene graphs of streets: train them, make them small, measure what it costs."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sparsestreet.scene.storage import load_scene

__version__ = "0.3.0"
__all__ = ["__version__", "load_scene"]


def __getattr__(name: str) -> Any:
    """``sparsestreet.load_scene`` brings torch along only when it is asked for."""
    if name == "load_scene":
        from sparsestreet.scene.storage import load_scene

        return load_scene
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
