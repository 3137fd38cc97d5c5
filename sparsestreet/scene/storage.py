"""The scene file: a trained scene that opens by itself, on any device, without the log it was made from.

Tensors in safetensors, and in its header, as JSON, what they mean: a version, the nodes and effects with their
settings, how the scene is rendered. No pickle, nothing of the log but the names of its tracks. Masks are not in it:
what they closed is gone.
"""

import json
from dataclasses import replace
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from sparsestreet.atomic import atomic_file
from sparsestreet.codec.container import MAGIC
from sparsestreet.records.run import RIG, RigRecord
from sparsestreet.records.strict_json import decoded_json
from sparsestreet.scene.loaded_scene import StoredScene, description, scene_of, without_masks
from sparsestreet.scene.street_file import ATTACHED, SUFFIX, attached_file, read_street
from sparsestreet.scene.views import VIEWS_FILE, RecordedViews, parsed_views, read_views

SCENE_FILE = "scene.safetensors"
"""Name of the scene file in a run's folder."""
STREET_FILE = f"scene{SUFFIX}"
"""Name of what may stand in its place there."""

_KEY = "sparsestreet"
_OURS = (".safetensors", SUFFIX)
_MOMENT = "Gaussians of one moment for viewers, or points"
_ARCHIVE, _PICTURE = "a zip archive", "a picture"
_OF_ENDINGS = {
    _MOMENT: (".ply", ".splat", ".ksplat", ".spz", ".sog"),
    "what AlpaSim loads beside the pictures of a scene": (".usdz",),
    "a page for browsers": (".html", ".htm"),
    "a video": (".mp4", ".mov", ".avi", ".mkv", ".webm"),
    "a checkpoint that a training goes on from": (".ckpt", ".pt", ".pth"),
    _ARCHIVE: (".zip",),
    _PICTURE: (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff"),
    "text": (".json", ".yaml", ".yml", ".csv", ".txt", ".md"),
}
_OF_BYTES = (
    (0, b"ply", _MOMENT), (0, b"PK\3\4", _ARCHIVE), (0, b"\x1f\x8b", "what gzip packed, such as a .spz"),
    (0, b"\x89PNG", _PICTURE), (0, b"\xff\xd8\xff", _PICTURE), (0, b"RIFF", _PICTURE), (0, b"<", "a page for browsers"),
    (4, b"ftyp", "a video"), (0, b"\x80\x02", "a pickle"), (0, b"{", "text"),
)  # fmt: skip
"""Place, bytes that stand there, and what begins so."""


def save_scene(path: Path | str, stored: StoredScene) -> None:
    """Write the whole file or nothing. A scene with masks is written as they leave it, and stays as it is.

    Raises OSError where it cannot be written, TypeError for settings that are no plain values.
    """
    scene = without_masks(stored.scene)
    header = description(replace(stored, scene=scene))
    # safetensors refuses what shares memory or is not contiguous.
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in scene.state_dict().items()}
    try:
        with atomic_file(Path(path)) as temporary:
            save_file(tensors, temporary, metadata={_KEY: json.dumps(header, allow_nan=False)})
    except SafetensorError as error:
        raise OSError(f"cannot write {path} ({error}): make room, or give another folder") from error


def load_scene(path: Path | str, device: torch.device | str = "cpu") -> StoredScene:
    """Open a scene file, a .street, or that of a run's folder; what it shows needs no log.

    Raises FileNotFoundError where there is none, ValueError for a file that is no scene or of another version.
    """
    path = scene_path(Path(path))
    stored = read_street(path) if path.suffix == SUFFIX else _read_scene(path)
    stored.scene.to(torch.device(device))
    return stored


def scene_path(path: Path) -> Path:
    """The scene file that a path names; in a run's folder, a .street where there is no other.

    Raises FileNotFoundError where there is none, ValueError for a file of another kind, which it names.
    """
    whole, small = path / SCENE_FILE, path / STREET_FILE
    found = path if not path.is_dir() else small if small.is_file() and not whole.is_file() else whole
    if not found.is_file():
        runs = sorted(one.parent.name for one in path.glob(f"*/{SCENE_FILE}"))[:3]
        there = f" (such as {', '.join(runs)} in it)" if runs else ""
        raise FileNotFoundError(
            f"there is no scene at {found}: give a {SCENE_FILE}, or the folder of a run that has one{there}"
        )
    _check_kind(found)
    return found


def _check_kind(path: Path) -> None:
    """Raise ValueError, saying what it is, for a file that is no scene by its ending and first bytes."""
    with path.open("rb") as file:
        head = file.read(9)
    found = SUFFIX if head[:8] == MAGIC else ".safetensors" if head[8:] == b"{" and head[4:8] == bytes(4) else None
    if found is not None and (found == path.suffix or (path.suffix not in _OURS and found != SUFFIX)):
        return _check_tensors(path) if found != SUFFIX else None
    if found is not None:
        raise ValueError(f"{path} is a {found} by its first bytes: give it that ending")
    what = next((what for what, endings in _OF_ENDINGS.items() if path.suffix.lower() in endings), None)
    what = what or next((what for at, start, what in _OF_BYTES if head[at:].startswith(start)), None)
    if what is None and path.suffix not in _OURS:
        what = "bytes that are not known" if head else "nothing"
    if what is not None:
        raise ValueError(f"{path} holds {what}, not a scene: open the run's folder, its {SCENE_FILE} or a {SUFFIX}")


def _check_tensors(path: Path) -> None:
    try:
        with safe_open(path, framework="pt") as file:
            ours = _KEY in (file.metadata() or {})
    except SafetensorError:
        return  # who reads it says what is wrong
    if not ours:
        raise ValueError(f"{path}: the file holds tensors but no scene of ours: give the {SCENE_FILE} that a run wrote")


def _read_scene(path: Path) -> StoredScene:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        return scene_of(json.loads(metadata[_KEY]), tensors)
    except (SafetensorError, json.JSONDecodeError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        # Whatever else is wrong: the header does not say what the tensors are.
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{path} is no scene file or is damaged ({reason}): write it again") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def views_of(scene: Path) -> RecordedViews:
    """The recorded views of a scene: a run's folder, a scene file in it, or a .street that has them.

    Raises FileNotFoundError where there are none, ValueError for damaged ones.
    """
    folder = scene if scene.is_dir() else scene.parent
    if not scene.is_file() and (folder / VIEWS_FILE).is_file():
        return read_views(folder / VIEWS_FILE)
    packed = _attached(scene, VIEWS_FILE)
    return read_views(folder / VIEWS_FILE) if packed is None else parsed_views(packed, f"{scene}: {VIEWS_FILE}")


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
    return found if views is None else found | {VIEWS_FILE: views.read_bytes()}


def _attached(scene: Path, name: str) -> str | None:
    try:
        file = scene_path(scene)
    except FileNotFoundError:
        return None
    content = attached_file(file, name) if file.suffix == SUFFIX else None
    return None if content is None else content.decode("utf-8", errors="replace")
