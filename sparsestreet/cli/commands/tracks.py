"""``sparsestreet data tracks``: what moves in the lidar of a log, as a table, pictures, and boxes in files."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from omegaconf import OmegaConf

from sparsestreet.cli.config.log_from_options import UsageError, configured_log, reader_of, without_folder
from sparsestreet.cli.config.validate import type_problem
from sparsestreet.naming import FOUND

if TYPE_CHECKING:
    from jaxtyping import Float64
    from omegaconf import DictConfig

    from sparsestreet.data.log import DrivingLog
    from sparsestreet.pictures.from_above import Moving
    from sparsestreet.pictures.sheets import Tile
    from sparsestreet.tracking.objects import FoundObject
    from sparsestreet.types import Track, View

NO_LOG = "no log is named: say sparsestreet data tracks DIR, DIR being the folder of a log"
ONE_LOG = "one recorded log is looked at, at a time: name one folder"
_STILL = 400_000
"""Returns of what stands still that are drawn."""
_COLUMNS, _TILE_WIDTH = 5, 240
_NEAR = 0.5
"""Meters ahead of a camera from which on all of a box must lie to be drawn in its image."""


def tracks(arguments: Sequence[str]) -> int:
    """Find, print and write. Raises UsageError for words that cannot be followed, ValueError without lidar."""
    given = [text.partition("=")[2] for text in arguments if text.startswith("to=")]
    if len(given) > 1 or "" in given:
        raise UsageError(f"to=DIR names one folder, got {' '.join(arguments)}")
    words, folder = without_folder([text for text in arguments if not text.startswith("to=")], ONE_LOG)
    words = words if any(text.startswith("tracks=") for text in words) else ["tracks=found", *words]
    cfg, told = configured_log(words, folder, no_log=NO_LOG, one_log=ONE_LOG)
    if cfg.tracks.name != "found":
        raise UsageError(f"this command finds tracks, and tracks={cfg.tracks.name} does not: leave it out")
    if problem := type_problem({"tracks": OmegaConf.to_container(cfg.tracks, resolve=True)}):
        raise UsageError(problem)
    if told:
        print(told)
    for line in _lines(cfg, Path(given[0]).expanduser() if given else None):
        print(line, flush=True)
    return 0


def _lines(cfg: "DictConfig", to: Path | None) -> "Iterator[str]":
    from dataclasses import replace

    from sparsestreet.cli.config.targets import made
    from sparsestreet.cli.runs.tracks import found_classes, joins
    from sparsestreet.kept import Kept
    from sparsestreet.pictures.from_above import kinds_in_words
    from sparsestreet.tracking.street import assumptions, check_lidar, found_objects, joined, tracks_of

    reader = reader_of(cfg)
    log, identity = reader.read(), reader.identity()
    check_lidar(log)
    log = log if identity is None else replace(log, kept=Kept(cfg.get("cache"), identity))
    yield from (f"note: {sentence}" for sentence in assumptions(log))
    if first := cfg.data.log.get("first_frame"):
        yield f"note: frames are counted from the first that is read, data.log.first_frame={first}, in the files too"
    objects = found_objects(log, made(cfg.tracks.settings))
    if log.kept.found:
        yield str(log.kept)
    sweeps = "one sweep, where nothing can be seen to move" if len(log.sweeps) == 1 else f"{len(log.sweeps)} sweeps"
    yield f"{log.name}: {kinds_in_words(Counter(each.kind for each in objects))} found in {sweeps}"
    yield from table(log, objects)
    found = tracks_of(log, objects, found_classes(cfg))
    out = Path("outputs/tracks") / log.name if to is None else to
    yield from _boxes(log.with_tracks(joined(log.tracks, found) if joins(cfg) else found), out)
    yield from _pictures(log, objects, found, out)


def table(log: "DrivingLog", objects: "Sequence[FoundObject]") -> "Iterator[str]":
    """Yield a line for each object under one that names the columns; none without objects."""
    from sparsestreet.tracking.street import moments

    if objects:
        yield f"{'name':<10}{'kind':<12}{'frames':>10}{'returns':>9}  {'length, width, height, m':<40}" + (
            f"{'path, m':>9}{'m/s':>6}{'sure':>6}"
        )
    at = moments(log)
    for number, each in enumerate(objects, 1):
        first, last = int(each.frames[0]), int(each.frames[-1])
        seconds = at[last][0] - at[first][0]
        sizes = ", ".join(f"{one:.2f} ± {off:.2f}" for one, off in zip(each.size, each.size_unsure, strict=True))
        speed = each.path_length / seconds if seconds > 0 else 0.0
        yield (
            f"{f'{FOUND}{number}':<10}{each.kind:<12}{f'{first} to {last}':>10}{int(each.returns.sum()):>9,}  "
            f"{sizes:<40}{each.path_length:>9.1f}{speed:>6.1f}{each.confidence:>6.2f}"
        )


def _boxes(log: "DrivingLog", out: Path) -> "Iterator[str]":
    """Write the boxes as DriveStudio's layout has them, where our reader of it finds them beside the log."""
    from sparsestreet.atomic import atomic_file
    from sparsestreet.data.drivestudio.annotations import frame_instances, instances_info, placed

    flavor = placed(log).flavor.name
    for name, content in (
        ("instances_info.json", instances_info(log, flavor)),
        ("frame_instances.json", frame_instances(log, flavor)),
    ):
        with atomic_file(out / "instances" / name) as file:
            file.write_bytes(content)
    yield f"boxes: {out / 'instances'}, in DriveStudio's layout; beside its images they are the boxes of the log"


def _pictures(
    log: "DrivingLog", objects: "Sequence[FoundObject]", found: "Sequence[Track]", out: Path
) -> "Iterator[str]":
    from PIL import Image

    from sparsestreet.atomic import atomic_file
    from sparsestreet.pictures.from_above import draw_from_above
    from sparsestreet.pictures.sheets import tile_sheet

    moving, still = _returns(log, objects, found)
    first = {view.indices[0]: view for view in reversed(log.views)}
    driven = np.stack([first[frame].camera.position.double().numpy() for frame in sorted(first)])
    draw_from_above(out / "from_above.png", f"{log.name}: what moves, from above", moving, still, driven)
    yield f"drawn: {out / 'from_above.png'}"
    tiles = [tile for each, track in zip(objects, found, strict=True) if (tile := _tile(log, each, track)) is not None]
    if tiles:
        sheet = tile_sheet(tiles, title=f"{log.name}: found objects", columns=_COLUMNS, tile_width=_TILE_WIDTH)
        with atomic_file(out / "objects.png") as file:
            Image.fromarray(sheet).save(file, format="png")
        yield f"drawn: {out / 'objects.png'}, {len(tiles)} of {len(found)} objects, where they are seen best"


def _returns(
    log: "DrivingLog", objects: "Sequence[FoundObject]", found: "Sequence[Track]"
) -> "tuple[list[Moving], Float64[np.ndarray, 'n 3']]":
    """What moves with the returns in its boxes, and some of all other returns."""
    import torch

    from sparsestreet.geometry.boxes import CarriedPoints
    from sparsestreet.pictures.from_above import Moving

    own: dict[str, list[np.ndarray]] = {track.name: [] for track in found}
    still, most = [np.zeros((0, 3))], max(_STILL // len(log.sweeps), 1)
    for sweep in log.sweeps.gray():
        rest = torch.ones(len(sweep.points), dtype=torch.bool)
        for track, rows, _ in CarriedPoints(sweep.points, sweep.time, sweep.index, found).riders:
            own[track.name].append(sweep.points[rows].double().numpy())
            rest[rows] = False
        left = sweep.points[rest].double().numpy()
        still.append(left[:: -(-len(left) // most) or 1])
    moving = [
        Moving(
            track.name,
            each.kind,
            each.world_from_object,
            each.size,
            np.concatenate([np.zeros((0, 3)), *own[track.name]]),
        )
        for each, track in zip(objects, found, strict=True)
    ]
    return moving, np.concatenate(still)


def _tile(log: "DrivingLog", each: "FoundObject", track: "Track") -> "Tile | None":
    """The object in the image that shows it best: large and, having many returns, not hidden. None where none does."""
    from sparsestreet.pictures.from_above import box_in_image
    from sparsestreet.pictures.sheets import Tile

    best, shown = None, 0.0
    returns = dict(zip(each.frames.tolist(), each.returns.tolist(), strict=True))
    for place, view in enumerate(log.views):
        if (count := returns.get(view.indices[0], 0)) and (corners := _corners_in(view, track)) is not None:
            score = count * _shown(corners, (view.camera.width, view.camera.height))
            best, shown = ((place, corners), score) if score > shown else (best, shown)
    if best is None:
        return None
    place, corners = best
    pixels = log.frames[place].image.numpy()
    frame, camera = log.views[place].indices
    name = log.camera_names[camera] if log.camera_names else str(camera)
    return Tile(f"{track.name}, {each.kind}: frame {frame}, camera {name}", box_in_image(pixels, corners, each.kind))


def _shown(corners: "Float64[np.ndarray, '8 2']", size: tuple[int, int]) -> float:
    """Pixels of the rectangle around a box that lie in the image; a box that is cut by its edge counts for less."""
    low, high = corners.min(0), corners.max(0)
    whole, inside = float(np.prod(high - low)), float(np.prod(np.minimum(high, size) - np.maximum(low, 0)))
    return inside * (inside / whole) ** 2


def _corners_in(view: "View", track: "Track") -> "Float64[np.ndarray, '8 2'] | None":
    """Pixels of the box's corners; None where the image does not show its middle, or the box reaches the camera."""
    import torch

    from sparsestreet.geometry.boxes import box_at
    from sparsestreet.geometry.cameras import project, transform_points
    from sparsestreet.pictures.from_above import BOX_CORNERS

    pose = box_at(track, view.indices[0], view.time)
    assert pose is not None  # returns are of frames with a box
    corners = torch.from_numpy(np.concatenate((BOX_CORNERS, np.zeros((1, 3)))) * track.size.double().numpy())
    pixels, depth, inside = project(view.camera, transform_points(pose, corners))
    return pixels[:8].double().numpy() if bool(inside[8]) and float(depth.min()) > _NEAR else None
