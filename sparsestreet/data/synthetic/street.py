"""Making a street: all frames rendered and written, or nothing."""

import dataclasses
import hashlib
import json
import os
import shutil
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from sparsestreet.data.synthetic.render import StreetFrame, render_frame
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import World, build_world
from sparsestreet.data.synthetic.write import StreetWriter

GENERATOR = 3
"""Raised whenever equal settings would give another street."""
_WORKERS = 2


def make_street(settings: StreetSettings, root: Path, progress: Callable[[int, int], None] | None = None) -> Path:
    """Writes the street that ``settings`` describe to ``root`` (DriveStudio's layout) and returns ``root``.

    A street of the same settings that is there already is kept as it is. The street is written beside ``root`` and
    renamed when complete: an interruption leaves nothing behind. ``progress`` is called with the number of frames
    done and the number of all frames.

    Raises FileExistsError where ``root`` holds anything else.
    """
    root = Path(root)
    if _holds_street(root, settings):
        return root
    partial = root.parent / f".{root.name}.{uuid.uuid4().hex[:8]}.partial"
    partial.mkdir(parents=True)
    try:
        _write(settings, partial, progress)
        try:
            os.rename(partial, root)
        except OSError:
            # Someone else may have finished the same street meanwhile; anything else in the way is an error.
            if not _holds_street(root, settings):
                raise
    finally:
        if partial.exists():
            shutil.rmtree(partial)
    return root


def street_name(settings: StreetSettings) -> str:
    """A folder's name for the street: its size, a hash of all that makes it but the seed, and the seed."""
    label = _label(settings)
    label["settings"].pop("seed")
    digest = hashlib.sha256(json.dumps(label, sort_keys=True).encode()).hexdigest()[:8]
    return f"{settings.width}x{settings.height}x{settings.num_frames}_{digest}_seed{settings.seed}"


def _holds_street(root: Path, settings: StreetSettings) -> bool:
    """Whether ``root`` is this very street; False where nothing is there yet."""
    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return False
    label = root / "street.json"
    if label.is_file() and json.loads(label.read_text()) == _label(settings):
        return True
    raise FileExistsError(
        f"{root} must be free or hold the street of exactly these settings, but it holds something else: "
        "choose another folder or remove this one"
    )


def _label(settings: StreetSettings) -> dict:
    """What street.json says; through JSON, so that tuples compare as the lists they become."""
    return json.loads(json.dumps({"generator": GENERATOR, "settings": dataclasses.asdict(settings)}))


def _write(settings: StreetSettings, folder: Path, progress: Callable[[int, int], None] | None) -> None:
    world = build_world(settings)
    writer = StreetWriter(folder, settings, world)
    for done, frame in enumerate(_frames(settings, world), start=1):
        writer.write_frame(frame)
        if progress is not None:
            progress(done, settings.num_frames)
    writer.finish()
    (folder / "street.json").write_text(json.dumps(_label(settings), indent=1))


def _frames(settings: StreetSettings, world: World) -> Iterator[StreetFrame]:
    """All frames in order, rendered by threads: NumPy lets go of the interpreter while it computes."""
    pending: deque[Future[StreetFrame]] = deque()
    executor = ThreadPoolExecutor(_WORKERS)
    try:
        for index in range(settings.num_frames):
            pending.append(executor.submit(render_frame, settings, world, index))
            # Few frames ahead of the writer, so that a long street does not pile up in memory.
            if len(pending) > _WORKERS + 1:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        executor.shutdown(cancel_futures=True)
