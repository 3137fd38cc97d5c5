"""What the scene is made of; each node class is one module: what is said about it, how it starts, what it answers.

``node`` is what all have in common; ``background`` stands still, ``rigid`` moves its objects along their tracks
(``tracked``) without changing their shape, ``smpl`` moves people by their skeletons.
"""

from sparsestreet.scene.nodes.background import Background, BackgroundSettings
from sparsestreet.scene.nodes.node import Instances, Node, NodeSettings
from sparsestreet.scene.nodes.rigid import Rigid, RigidSettings
from sparsestreet.scene.nodes.smpl import Smpl, SmplSettings
from sparsestreet.scene.nodes.tracked import Tracked, TrackedSettings

__all__ = [
    "Background",
    "BackgroundSettings",
    "Instances",
    "Node",
    "NodeSettings",
    "Rigid",
    "RigidSettings",
    "Smpl",
    "SmplSettings",
    "Tracked",
    "TrackedSettings",
]
