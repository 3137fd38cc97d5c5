"""From a log to the terms of its moved views."""

import logging
from collections.abc import Mapping

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.lidar import EdgeShift, edge_shift
from sparsestreet.geometry.boxes import displacement, without_frames
from sparsestreet.phases import stage
from sparsestreet.scene.assignment import assign_tracks
from sparsestreet.scene.nodes import NodeSettings, RigidSettings
from sparsestreet.training.moved_views.returns import collect
from sparsestreet.training.moved_views.settings import MovedViews
from sparsestreet.training.moved_views.term import MovedViewTerm

_log = logging.getLogger(__name__)

MOVES = 0.5
"""Meters that an object which no node takes must get before it counts as moving."""
NOTICEABLE = 1.0, 2.0
"""Pixels between the edges of lidar and images, across and down, from which on a user is warned. Embedded streets that
fit have up to 0.4 and 1.0: lidars stand above cameras and look over edges."""


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
    report_shift(edge_shift(data.split.train, sweeps))
    return MovedViewTerm(settings, returns, seed)


def report_shift(shift: EdgeShift | None) -> None:
    """What lidar says of views beside the path is as right as it fits the recorded images."""
    if shift is None:
        _log.info("too few edges are seen by lidar and cameras to tell how well the two fit each other")
        return
    wrong = abs(shift.right) >= NOTICEABLE[0] or abs(shift.down) >= NOTICEABLE[1]
    level = logging.WARNING if wrong else logging.INFO
    advice = ": check calibration, poses and stamps, or train with moved_views=none" if wrong else ""
    _log.log(
        level,
        "edges of the images lie %.1f pixels to the right of those of the lidar and %.1f below%s",
        shift.right,
        shift.down,
        advice,
    )
