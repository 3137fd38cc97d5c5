"""``sparsestreet data``: logs are checked, converted and made, their objects found, and masks of their images made."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sparsestreet.cli.commands.masks import masks
from sparsestreet.cli.commands.options import shown
from sparsestreet.cli.commands.tracks import tracks
from sparsestreet.cli.config.log_from_options import UsageError, compose_data, configured_log, reader_of
from sparsestreet.cli.config.validate import type_problem
from sparsestreet.data.check import report_check
from sparsestreet.data.convert import Source, check_free, partial_folder
from sparsestreet.data.convert import convert as write_converted
from sparsestreet.data.drivestudio import DriveStudioWriter
from sparsestreet.data.log import counted, split
from sparsestreet.data.reader import LogReader

_NO_LOG = "no log is named: say sparsestreet data convert from=DIR to=DIR"
_ONE_LOG = "data=synthetic has no folder to convert from: leave from=... out"
_NOT_OF_A_LOG = ("root", "parent", "cache_mb")
"""Options of readers that change nothing of what is read."""
_SETTINGS = tuple(field.name for field in fields(DriveStudioWriter))


@dataclass(frozen=True)
class _Words:
    """The command's, sorted."""

    to: Path
    origin: Path | None
    settings: tuple[str, ...]
    """Of the writer: ``jpeg_quality=95``."""
    log: tuple[str, ...]


def convert(arguments: Sequence[str]) -> int:
    """Write the folder; 2 on wrong usage, 1 where the log or the disk has a fault, 130 after Ctrl-C."""
    to: Path | None = None
    try:
        words = _sorted(arguments)
        to = words.to.resolve()
        return _convert(words, to)
    except BrokenPipeError:
        raise  # somebody reads no more of our output
    except (ValueError, OSError, HydraException, OmegaConfBaseException) as error:
        print(f"sparsestreet data convert: {error}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    except KeyboardInterrupt:
        partial = None if to is None else partial_folder(to)
        left = f"what is written stays in {partial}: give the same command to go on, or remove the folder"
        is_left = partial is not None and partial.is_dir()
        print(f"sparsestreet data convert: stopped, {left if is_left else 'nothing was written'}", file=sys.stderr)
        return 130


def _convert(words: _Words, to: Path) -> int:
    writer = _writer(words.settings)
    cfg, found = configured_log(words.log, words.origin, no_log=_NO_LOG, one_log=_ONE_LOG)
    if found:
        print(found)
    reader = reader_of(cfg)
    if reader.folder.resolve() in (to, *to.parents):
        raise UsageError(f"to={words.to} lies in the log itself: name a place outside of {reader.folder}")
    check_free(to)
    log = reader.read()
    made = write_converted(log, _source(log.name, reader, cfg), writer, to, shown)
    there = f", {made.found} of them there already" if made.found else ""
    print(
        f"{words.to}: {made.files} files{there}, {made.bytes / 1e6:.1f} MB, "
        f"{log.num_frames} frames of {log.num_cameras} cameras"
    )
    for sentence in made.losses:
        print(f"  lost or changed: {sentence}")
    for sentence in made.notes:
        print(f"  note: {sentence}")
    return 0


def _writer(settings: Sequence[str]) -> DriveStudioWriter:
    """Return the writer of ``jpeg_quality=95 flavor=waymo``. Raises UsageError for values that it does not take."""
    values: Any = OmegaConf.to_container(OmegaConf.from_dotlist(list(settings)))
    target = f"{DriveStudioWriter.__module__}.{DriveStudioWriter.__qualname__}"
    if problem := type_problem({"_target_": target, **values}):
        raise UsageError(problem)
    try:
        return DriveStudioWriter(**values)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _source(name: str, reader: LogReader, cfg: DictConfig) -> Source:
    options: Any = OmegaConf.to_container(cfg.data.log, resolve=True)
    chosen = {key: value for key, value in options.items() if key not in _NOT_OF_A_LOG}
    return Source(name, reader.data_hash(), chosen)


def _sorted(arguments: Sequence[str]) -> _Words:
    """Raise UsageError for words that are given twice or not at all."""
    given: dict[str, Path] = {}
    settings, log = [], []
    for text in arguments:
        key, _, value = text.partition("=")
        if key in ("from", "to"):
            if key in given or not value:
                raise UsageError(f"{key}=DIR names one folder, got {' '.join(arguments)}")
            given[key] = Path(value).expanduser()
        else:
            (settings if key in _SETTINGS else log).append(text)
    if "to" not in given:
        raise UsageError("to=DIR is missing: name the folder that is written")
    if "from" in given and any(text.startswith("data.root=") for text in log):
        raise UsageError("from=DIR and data.root=DIR name the same: leave one out")
    return _Words(given["to"], given.get("from"), tuple(settings), tuple(log))


USAGE = """\
sparsestreet data check DIR [data=nuscenes data.log.scene=scene-0061 data.log.last_frame=50 ...]
    print what is wrong with a log, or with the part that is chosen (exit status 1), or its summary;
    without data=... the folder's files tell which reader is asked
sparsestreet data convert from=DIR to=DIR [data=... jpeg_quality=95 flavor=auto ...]
    write a log in DriveStudio's layout; the same command goes on where it was interrupted
    jpeg_quality: 1 to 100; null writes PNGs under the layout's names in .jpg, without loss
    flavor: waymo has rigid cameras on a vehicle, nuscenes a pose for each image; auto takes waymo for Waymo's logs
      sparsestreet data convert from=/data/nuscenes to=scene-0061 data.log.scene=scene-0061 data.log.width=960
      sparsestreet data convert data=synthetic seed=3 to=street
sparsestreet data make [seed=N] [data.log.settings.width=W ...]
    write a synthetic street, and print where it lies
sparsestreet data tracks DIR [data=... tracks.settings.min_moved=2.0 tracks.join=true to=DIR ...]
    find what moves in the lidar of a log, annotated or not: a table, boxes in DriveStudio's layout, a map from above
    and a sheet of images, in DIR (outputs/tracks/LOG); the same command again takes the answer that is kept
sparsestreet data masks DIR model=FILE classes=cityscapes|ade20k|coco|coco80|NAMES [to=DIR size=1024 threads=4 ...]
    write masks of sky, people and vehicles by a semantic segmenter in ONNX's format, for data.log.masks=DIR, and a
    sheet of images that shows them, in DIR (outputs/masks/LOG); the same command goes on where it was interrupted
    classes: what the segmenter tells apart; NAMES is a file with the name of a class a line
    size: pixels of the longer side that it sees; mean, std: its scaling of colors, else ImageNet's
"""


_NO_CHECKED = "no log is named: say sparsestreet data check DIR, DIR being the folder of a log"


def data(arguments: list[str]) -> int:
    """Run the sub-command; 2 on wrong usage."""
    verb, rest = (arguments[0], arguments[1:]) if arguments else ("", [])
    if verb not in ("check", "convert", "make", "masks", "tracks") or "--help" in rest:
        print(USAGE)
        return 0 if verb in ("-h", "--help") or "--help" in rest else 2
    if verb == "convert":
        return convert(rest)
    try:
        return {"check": _check, "make": _make, "masks": masks, "tracks": tracks}[verb](rest)
    except BrokenPipeError:
        raise  # somebody reads no more of our output
    except (ValueError, OSError, ImportError) as error:
        print(f"sparsestreet data {verb}: {error}", file=sys.stderr)
        return 2


def _check(arguments: list[str]) -> int:
    folders = [text for text in arguments if "=" not in text and not text.startswith("-")]
    overrides = [text for text in arguments if text not in folders]
    one_log = f"one recorded log is checked at a time, got {' '.join(arguments)}: name one folder"
    if len(folders) > 1:
        raise UsageError(one_log)
    cfg, found = configured_log(overrides, Path(folders[0]) if folders else None, no_log=_NO_CHECKED, one_log=one_log)
    if found:
        print(found)
    return report_check(
        reader_of(cfg), split_of=partial(split, **{key: cfg.split[key] for key in ("stride", "offset", "cameras")})
    )


def _make(overrides: list[str]) -> int:
    cfg = compose_data(overrides)
    if "root" in set(cfg.data):
        raise UsageError("only data=synthetic can be made; a recorded drive is read as it is")
    reader = reader_of(cfg)
    log = reader.read()
    print(f"{reader.folder}: {counted(log.num_frames, 'frame')} of {counted(log.num_cameras, 'camera')}")
    return 0
