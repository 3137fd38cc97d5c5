"""What the scene is made of; each node class is one module: what is said about it, how it starts, what it answers.

``node`` is what all have in common. Of a whole street: ``background`` stands still, ``vibrating`` is a background whose
Gaussians swing and fade. Of objects: ``rigid`` moves them along their tracks (``tracked``) without changing their shape.
"""

from sparsestreet.scene.nodes.background import Background, BackgroundSettings
from sparsestreet.scene.nodes.node import Instances, Node, NodeSettings
from sparsestreet.scene.nodes.rigid import Rigid, RigidSettings
from sparsestreet.scene.nodes.tracked import Tracked, TrackedSettings
from sparsestreet.scene.nodes.vibrating import Vibrating, VibratingSettings

__all__ = [
    "Background",
    "BackgroundSettings",
    "Instances",
    "Node",
    "NodeSettings",
    "Rigid",
    "RigidSettings",
    "Tracked",
    "TrackedSettings",
    "Vibrating",
    "VibratingSettings",
]
