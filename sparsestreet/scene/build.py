"""From a driving log to a scene graph ready for training."""

import logging
import zlib
from collections.abc import Mapping, Sequence

import torch

from sparsestreet.data.log import DrivingLog
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes.node import Node
from sparsestreet.scene.seeds import BackgroundSettings, RigidSettings
from sparsestreet.scene.sky import Sky, SkySettings
from sparsestreet.types import Frame

_log = logging.getLogger(__name__)


def build_scene(
    log: DrivingLog,
    train_frames: Sequence[Frame],
    held_out: frozenset[int],
    nodes: Mapping[str, BackgroundSettings | RigidSettings],
    sky: SkySettings | None,
    seed: int,
) -> SceneGraph:
    """Seed every node class from what training may see.

    Args:
        log: the drive.
        train_frames: views that random points are placed in and colored by.
        held_out: integer frames whose sweeps and boxes must not be used.
        nodes: name of the node class -> its seeds. A class without any instance is left out, and the log says so.
        sky: settings of the cube map; None for a scene without sky.
        seed: each node draws from its own stream, so a change of one leaves the others as they are.
    """
    built: dict[str, Node] = {}
    for name, seeds in nodes.items():
        generator = torch.Generator().manual_seed(seed + zlib.crc32(name.encode()))
        node = seeds.build(log, train_frames, held_out, generator)
        if node is None:
            _log.warning("node %r has no instance in %s: the scene goes without it", name, log.name)
        else:
            _log.info("node %r starts with %d Gaussians", name, len(node.rows))
            built[name] = node
    return SceneGraph(built, None if sky is None else Sky(sky))
