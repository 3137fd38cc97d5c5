"""The nodes of a scene, each with its settings, its initialization and its interface (``node``).

Three classes hold a whole street: ``Background`` stands still, Gaussians of ``Vibrating`` swing and fade, and a network
deforms those of ``Field``. Three classes hold objects and move them along their tracks (``Tracked``). ``Rigid`` keeps
their shape, ``Deformable`` changes it with a network, and ``Smpl`` moves people by their skeletons.
"""

from sparsestreet.scene.nodes.background import Background, BackgroundSettings
from sparsestreet.scene.nodes.deformable import Deformable, DeformableSettings, Field, FieldSettings, NetworkSettings
from sparsestreet.scene.nodes.node import Instances, Node, NodeSettings
from sparsestreet.scene.nodes.smpl import Smpl, SmplSettings
from sparsestreet.scene.nodes.tracked import Rigid, RigidSettings, Tracked, TrackedSettings
from sparsestreet.scene.nodes.vibrating import Vibrating, VibratingSettings

__all__ = [
    "Background",
    "BackgroundSettings",
    "Deformable",
    "DeformableSettings",
    "Field",
    "FieldSettings",
    "Instances",
    "NetworkSettings",
    "Node",
    "NodeSettings",
    "Rigid",
    "RigidSettings",
    "Smpl",
    "SmplSettings",
    "Tracked",
    "TrackedSettings",
    "Vibrating",
    "VibratingSettings",
]
