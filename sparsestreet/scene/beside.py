"""What training leaves beside a scene: in its run's folder, or within a .street."""

from pathlib import Path

from sparsestreet.records.run import RIG, RigRecord
from sparsestreet.records.strict_json import decoded_json
from sparsestreet.scene.storage import scene_path
from sparsestreet.scene.street_file import ATTACHED, SUFFIX, attached_file
from sparsestreet.scene.views import FILE_NAME, RecordedViews, parsed_views, read_views


def views_of(scene: Path) -> RecordedViews:
    """The recorded views of a scene: a run's folder, a scene file in it, or a .street that has them.

    Raises FileNotFoundError where there are none, ValueError for damaged ones.
    """
    folder = scene if scene.is_dir() else scene.parent
    if not scene.is_file() and (folder / FILE_NAME).is_file():
        return read_views(folder / FILE_NAME)
    packed = _attached(scene, FILE_NAME)
    return read_views(folder / FILE_NAME) if packed is None else parsed_views(packed, f"{scene}: {FILE_NAME}")


def rig_record(scene: Path) -> RigRecord | None:
    """What is known of the recording car of a scene; None: nothing. Raises ValueError for a damaged record."""
    folder = scene if scene.is_dir() else scene.parent
    packed = _attached(scene, RIG.name)
    return RIG.find(folder) if packed is None else decoded_json(packed, RigRecord, f"{scene}: {RIG.name}")


def files_beside(scene: Path, views: Path | None = None) -> dict[str, bytes]:
    """The files that go into a .street of a scene; ``views``: another file of views.

    Raises FileNotFoundError where that file is not there.
    """
    folder = scene if scene.is_dir() else scene.parent
    found = {}
    for name in ATTACHED:
        packed = _attached(scene, name)
        if packed is not None:
            found[name] = packed.encode("utf-8")
        elif (folder / name).is_file():
            found[name] = (folder / name).read_bytes()
    return found if views is None else found | {FILE_NAME: views.read_bytes()}


def _attached(scene: Path, name: str) -> str | None:
    try:
        file = scene_path(scene)
    except FileNotFoundError:
        return None
    content = attached_file(file, name) if file.suffix == SUFFIX else None
    return None if content is None else content.decode("utf-8", errors="replace")
