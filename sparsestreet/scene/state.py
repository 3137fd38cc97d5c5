"""What a scene is asked for: the state of a node at an instant, and the options of parts."""

from dataclasses import dataclass, field

from sparsestreet.ops import SplatSettings


@dataclass(frozen=True)
class SceneState:
    """The state of training while a view is rendered.

    >>> SceneState(progress=0.5, training=True) == FINISHED
    False
    """

    progress: float = 1.0
    """Fraction of the run in [0, 1]; 1 for a finished scene."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics in use; a node that stores fewer uses what it has."""
    training: bool = False
    """Whether a training step renders the view; if so, noise and sampling of a node are on."""
    screen_gradients: bool = False
    """Whether density control is running and will read the gradients of the Gaussians' positions on screen."""
    step: int = 0
    """Number of optimizer steps before this one, for terms that come at some steps only."""
    harmonics_rest: bool = False
    """Whether the step leaves the coefficients after the first as they are: they get no gradient."""


FINISHED = SceneState()
"""A scene whose training is over."""


@dataclass(frozen=True)
class RenderOptions:
    """How a scene is rendered; training, pruning and evaluation take the same."""

    settings: SplatSettings = field(default_factory=SplatSettings)
    backend: str = "auto"
    replay: bool = False
    """Whether a GPU renders views as CUDA graphs (``sparsestreet.ops.splat``)."""


DEFAULT_OPTIONS = RenderOptions(SplatSettings(antialias=True))
"""With antialias scenes end 0.2 to 0.5 dB higher after the same seconds (docs/length.md)."""
