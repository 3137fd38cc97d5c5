"""Where the objects of a run come from: its log, its lidar, nowhere, or what the run has found before."""

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from sparsestreet.cli.runs.folder import TRACKS_FILE
from sparsestreet.data.log import DrivingLog, split
from sparsestreet.naming import one_line
from sparsestreet.records.strict_json import EXACT, RecordError, json_line, read_json, version, write_atomically
from sparsestreet.scene.edits.edits import objects_of
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.tracking.bodies import with_bodies
from sparsestreet.tracking.objects import Kind
from sparsestreet.tracking.settings import TrackingSettings
from sparsestreet.tracking.street import found_tracks, joined
from sparsestreet.types import Track

_log = logging.getLogger(__name__)


def with_tracks(cfg: DictConfig, log: DrivingLog, run: Path | None = None) -> DrivingLog:
    """The log with the objects that the configuration asks for (conf/tracks), and their bodies.

    ``run``: a run that has begun, whose found objects are taken if it has kept any; None: they are found.

    Raises ValueError where they are to be found, and there is no lidar, or a kind of them has no class; for a run
    whose file is damaged, or not of this log; and for bodies that are neither fitted nor null.
    """
    boxed, bodies = _with_boxes(cfg, log, run), (cfg.get("tracks") or {}).get("bodies")
    if bodies not in (None, "fitted"):
        raise ValueError(f"tracks.bodies is fitted or null, got {bodies!r}")
    if bodies is None:
        return boxed
    # A run has the fitted bodies in its scene and its checkpoints: fitted anew, they only say who has one.
    classes = {name for node in cfg.node.values() if node.get("has_body_pose") for name in node.get("classes") or ()}
    return with_bodies(boxed, _held_out(cfg, log), classes)


def _held_out(cfg: DictConfig, log: DrivingLog) -> frozenset[int]:
    parts = split(log, stride=cfg.split.stride, offset=cfg.split.offset, cameras=cfg.split.cameras)
    return parts.held_out_indices


def _with_boxes(cfg: DictConfig, log: DrivingLog, run: Path | None) -> DrivingLog:
    asked = cfg.get("tracks") or {"name": "log"}  # runs of earlier versions do not say
    if asked["name"] == "none":
        return log.with_tracks(())
    if not finds(cfg, log):
        return log
    if asked["name"] == "log":
        said = "%s has no boxes: objects are found in its lidar (tracks=found; tracks=none goes without)"
        _log.info(said, log.name)
    elif not _has_objects(cfg):
        said = "method=%s has no objects: found ones only carry returns to the instants of images"
        _log.info(said, cfg.method.name)
    own = log.tracks if joins(cfg) else ()
    if run is not None and (run / TRACKS_FILE).exists():
        return log.with_tracks((*own, *read_tracks(run, log)))
    settings = instantiate(asked["settings"]) if "settings" in asked else TrackingSettings()
    return log.with_tracks(joined(own, found_tracks(log, settings, _held_out(cfg, log), found_classes(cfg))))


def finds(cfg: DictConfig, log: DrivingLog) -> bool:
    """Whether objects are found in the lidar of a log."""
    name = (cfg.get("tracks") or {"name": "log"})["name"]
    return name == "found" or (name == "log" and not log.is_annotated and len(log.sweeps) > 0 and _has_objects(cfg))


def joins(cfg: DictConfig) -> bool:
    """Whether found objects join the log's own. Raises ValueError for what is neither true nor false."""
    join = (cfg.get("tracks") or {}).get("join", False)
    if not isinstance(join, bool):
        raise ValueError(f"tracks.join is true or false, got {join!r}")
    return join


def _has_objects(cfg: DictConfig) -> bool:
    """Whether some node takes objects of a class."""
    return any(node.get("classes") for node in cfg.node.values())


def found_classes(cfg: DictConfig) -> dict[str, str]:
    """Kind of a found object -> the first class of the log that data.classes has for it. Raises ValueError for none."""
    for kind in (kinds := get_args(Kind)):
        if not cfg.data.classes.get(kind):
            raise ValueError(f"a found {kind} needs a class: name one, data.classes.{kind}=[{kind}]")
    return {kind: cfg.data.classes[kind][0] for kind in kinds}


Numbers = tuple[float, ...]


@dataclass(frozen=True)
class _Entry:
    """One found object as JSON."""

    name: str
    class_name: str
    frames: tuple[int, ...]
    poses: tuple[Numbers, ...] = field(metadata=EXACT)
    """The 16 numbers of world_from_object at each frame, row by row."""
    size: Numbers = field(metadata=EXACT)
    times: Numbers | None = field(default=None, metadata=EXACT)
    span: Numbers | None = field(default=None, metadata=EXACT)


@dataclass(frozen=True)
class _File:
    tracks: tuple[_Entry, ...]
    format: int = version(1, "it is of another version of SparseStreet; go on with that, or train again")


def write_tracks(run: Path, tracks: Iterable[Track]) -> None:
    """Keep those that were found in the folder of a run, an object a line."""
    path = run / TRACKS_FILE
    entries = [
        _Entry(
            track.name,
            track.class_name,
            tuple(track.frames.tolist()),
            tuple(tuple(pose) for pose in track.world_from_object.flatten(1).tolist()),
            tuple(track.size.tolist()),
            None if track.times is None else tuple(track.times.tolist()),
            track.span,
        )
        for track in tracks
        if track.found
    ]
    lines = ",\n".join(json_line(entry, f"{path}: {entry.name}") for entry in entries)
    write_atomically(path, f'{{"format": 1, "tracks": [\n{lines}\n]}}\n')


def read_tracks(run: Path, log: DrivingLog) -> tuple[Track, ...]:
    """Read what ``write_tracks`` wrote. Raises ValueError, naming file and object, for what is no object of the log."""
    path = run / TRACKS_FILE
    return tuple(_track(entry, f"{path}: {one_line(entry.name)}", log) for entry in read_json(path, _File).tracks)


def _track(entry: _Entry, where: str, log: DrivingLog) -> Track:
    count, remedy = len(entry.frames), "train again"
    if not count or min(entry.frames) < 0 or max(entry.frames) >= log.num_frames:
        raise RecordError(f"{where} has frames beyond the {log.num_frames} of {log.name}: {remedy}")
    whole = len(entry.poses) == count and all(len(pose) == 16 for pose in entry.poses) and len(entry.size) == 3
    times, span = entry.times, entry.span
    if log.stamps:
        whole = whole and times is not None and span is not None and (len(times), len(span)) == (count, 2)
        whole = whole and all(map(math.isfinite, span or ()))
    if not whole:
        raise RecordError(f"{where} lacks a size, a pose of 16 numbers for each frame, their times or a span: {remedy}")
    double = torch.float64
    try:
        return Track(
            entry.name,
            entry.class_name,
            torch.tensor(entry.frames),
            torch.tensor(entry.poses, dtype=double).reshape(count, 4, 4),
            torch.tensor(entry.size),
            times=torch.tensor(times, dtype=double) if log.stamps else None,
            span=(span[0], span[1]) if span and log.stamps else None,
            found=True,
        )
    except ValueError as error:
        raise RecordError(f"{where}: {error}") from error


def check_objects(scene: SceneGraph, log: DrivingLog) -> None:
    """Raise ValueError where a scene has objects that are none of those that were found in its log."""
    names = {track.name for track in log.tracks}
    if lost := [name for name in objects_of(scene) if name not in names]:
        raise ValueError(
            f"the scene has an object {one_line(lost[0])} that was not found in {log.name}: put back the {TRACKS_FILE} "
            "of its run, or train it again"
        )
