"""Makes a street: renders and writes all frames, or nothing."""

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

import torch

from sparsestreet.data.synthetic.render import StreetFrame, render_frame
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import World, build_world
from sparsestreet.data.synthetic.write import StreetWriter

GENERATOR = 3
"""Version of the generator; raised whenever equal settings would give another street."""
MOST_WORKERS = 16
"""Frames that are traced at once, at most: one of 960x640 with three cameras takes 0.4 GB and 10 s of a core."""
_LATER = frozenset(
    {
        "delays", "delays_known", "exposure_walk", "white_balance", "pose_noise", "box_noise", "readout",
        "readout_direction", "readout_known", "shutter_time", "shutter_time_known", "hood", "hood_cameras",
        "hood_known", "tunnel", "jpeg", "limp", "num_crossing", "dirt", "night", "turn",
    }
)  # fmt: skip
"""Settings that came after ``GENERATOR``; at their defaults a street is as it was without them."""


def make_street(settings: StreetSettings, root: Path, progress: Callable[[int, int], None] | None = None) -> Path:
    """Writes the street that ``settings`` describe to ``root`` (DriveStudio's layout) and returns ``root``.

    An existing street of the same settings is kept. The street is written next to ``root`` and renamed when complete,
    so an interruption leaves nothing. ``progress`` is called with the number of finished frames and of all frames.

    Raises FileExistsError if ``root`` holds anything else.
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
            # Another process may have finished the same street meanwhile; anything else in the way is an error.
            if not _holds_street(root, settings):
                raise
    finally:
        if partial.exists():
            shutil.rmtree(partial)
    return root


def street_name(settings: StreetSettings) -> str:
    """Returns a folder's name for the street: its size, a hash of all settings but the seed, and the seed.

    >>> street_name(StreetSettings(num_frames=5, seed=7)).startswith("320x192x5_")
    True
    """
    label = _label(settings)
    label["settings"].pop("seed")
    digest = hashlib.sha256(json.dumps(label, sort_keys=True).encode()).hexdigest()[:8]
    return f"{settings.width}x{settings.height}x{settings.num_frames}_{digest}_seed{settings.seed}"


def _holds_street(root: Path, settings: StreetSettings) -> bool:
    """Whether ``root`` holds this very street; False if nothing is there yet."""
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
    """Returns the content of street.json, converted by JSON so that tuples compare as the lists they become."""
    # Streets without an effect keep the name that they had before streets could have it.
    usual = {field.name: field.default for field in dataclasses.fields(settings) if field.name in _LATER}
    said = {name: value for name, value in dataclasses.asdict(settings).items() if value != usual.get(name, ...)}
    return json.loads(json.dumps({"generator": GENERATOR, "settings": said}))


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
    """Yields all frames in order, rendered by threads, because NumPy releases the interpreter while it computes."""
    pending: deque[Future[StreetFrame]] = deque()
    workers = max(2, min(MOST_WORKERS, torch.get_num_threads()))
    executor = ThreadPoolExecutor(workers)
    try:
        for index in range(settings.num_frames):
            pending.append(executor.submit(render_frame, settings, world, index))
            # Render few frames ahead of the writer, so that a long street does not fill the memory.
            if len(pending) > workers + 1:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        executor.shutdown(cancel_futures=True)
