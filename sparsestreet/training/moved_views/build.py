"""From a log to the terms of its moved views."""

import logging
from collections.abc import Mapping

from sparsestreet.data.datamodule import StreetData
from sparsestreet.geometry.boxes import without_frames
from sparsestreet.geometry.displacement import displacement
from sparsestreet.phases import stage
from sparsestreet.scene.assignment import assign_tracks
from sparsestreet.scene.nodes import NodeSettings, RigidSettings
from sparsestreet.training.moved_views.returns import collect
from sparsestreet.training.moved_views.settings import MovedViews
from sparsestreet.training.moved_views.term import MovedViewTerm

_log = logging.getLogger(__name__)

MOVES = 0.5
"""Meters that an object which no node takes must get before it counts as moving."""


def moved_view_term(
    settings: MovedViews, data: StreetData, nodes: Mapping[str, NodeSettings], seed: int
) -> MovedViewTerm | None:
    """The terms of a run's moved views; None where no lidar says what these show. The program's log says which.

    Objects of rigid nodes are seen in moved views as the lidar saw them in the same instant. Of all other objects that
    move nothing is known there, nor of what lies behind them.
    """
    log, held_out = data.driving_log, data.split.held_out_indices
    sweeps = log.sweeps.where(lambda index: index not in held_out)
    if not len(sweeps):
        _log.info("no view beside the path is trained on: %s has no lidar", log.name)
        return None
    by_node = assign_tracks(log.tracks, nodes).by_node
    rigid = [track for name, tracks in by_node.items() if isinstance(nodes[name], RigidSettings) for track in tracks]
    taken = {track.name for tracks in by_node.values() for track in tracks}
    moving = [track for track in log.tracks if track.name in taken or displacement(track) > MOVES]
    moving, rigid = without_frames(moving, held_out), without_frames(rigid, held_out)
    with stage("points"):
        returns = collect(sweeps, data.split.train, moving, rigid, settings, seed)
    _log.info(
        "views beside the path: %s returns of the street, of mean weight %.2f (1: an image before or after shows the "
        "same color)",
        f"{len(returns.street):,}",
        returns.agreement(),
    )
    return MovedViewTerm(settings, returns, seed)
