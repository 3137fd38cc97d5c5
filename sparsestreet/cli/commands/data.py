"""``sparsestreet data``: logs are checked, converted and made."""

import sys
from functools import partial
from pathlib import Path

from sparsestreet.cli.commands.convert import convert
from sparsestreet.cli.config.log_from_options import UsageError, compose_data, configured_log, reader_of
from sparsestreet.data.check import report_check
from sparsestreet.data.log import counted, split

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
"""


_NO_LOG = "no log is named: say sparsestreet data check DIR, DIR being the folder of a log"


def data(arguments: list[str]) -> int:
    """Run the sub-command; 2 on wrong usage."""
    verb, rest = (arguments[0], arguments[1:]) if arguments else ("", [])
    if verb not in ("check", "convert", "make") or "--help" in rest:
        print(USAGE)
        return 0 if verb in ("-h", "--help") or "--help" in rest else 2
    if verb == "convert":
        return convert(rest)
    try:
        return _check(rest) if verb == "check" else _make(rest)
    except BrokenPipeError:
        raise  # somebody reads no more of our output
    except (ValueError, OSError) as error:
        print(f"sparsestreet data {verb}: {error}", file=sys.stderr)
        return 2


def _check(arguments: list[str]) -> int:
    folders = [text for text in arguments if "=" not in text and not text.startswith("-")]
    overrides = [text for text in arguments if text not in folders]
    one_log = f"one recorded log is checked at a time, got {' '.join(arguments)}: name one folder"
    if len(folders) > 1:
        raise UsageError(one_log)
    cfg, found = configured_log(overrides, Path(folders[0]) if folders else None, no_log=_NO_LOG, one_log=one_log)
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
