"""How far a training has come: what a scene has to know beside the view."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SceneState:
    """The state of training while a view is rendered."""

    progress: float = 1.0
    """Fraction of the run in [0, 1]; 1 for a finished scene."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics in use; a node that stores fewer uses what it has."""
    training: bool = False
    """True inside a training step: noise and sampling of a node are on."""
    screen_gradients: bool = False
    """Whether somebody will ask how far the image wants Gaussians to move on screen: density control, while it runs."""


FINISHED = SceneState()
"""A scene whose training is over."""
