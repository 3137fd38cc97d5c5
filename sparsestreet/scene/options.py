"""How a scene is rendered."""

from dataclasses import dataclass, field

from sparsestreet.ops import SplatSettings


@dataclass(frozen=True)
class RenderOptions:
    """How a scene is rendered; training, pruning and evaluation take the same."""

    settings: SplatSettings = field(default_factory=SplatSettings)
    backend: str = "auto"


DEFAULT_OPTIONS = RenderOptions()
