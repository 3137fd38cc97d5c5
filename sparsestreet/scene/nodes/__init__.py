"""What the scene is made of: each node answers with its Gaussians in the world at a time."""

from sparsestreet.scene.nodes.background import Background
from sparsestreet.scene.nodes.node import Node
from sparsestreet.scene.nodes.rigid import Rigid

__all__ = ["Background", "Node", "Rigid"]
