"""Pictures of one view from several arms, small enough to travel in a page."""

import base64
import io
import json
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from sparsestreet.pictures.images import drawn_views, picture_path
from sparsestreet.records.quality import QUALITY
from sparsestreet.report.arms import Arm
from sparsestreet.report.collect import RunRecord

WIDTH = 640
"""Pixels; wider pictures are scaled down to this width."""
VIEWS = 2
"""Number of views of each scene."""


def comparison_data(arms: Sequence[Arm]) -> str | None:
    """Returns JSON of the views with their images as data URLs, truth first; None if there is no view to compare.

    Each scene shows one seed, which most of the arms have (the lowest of several), and the first ``VIEWS`` views that
    evaluation drew.
    """
    views = []
    scenes = sorted({record.summary.run.scene for arm in arms for record in arm.records})
    for scene in scenes:
        seed = _seed_of_most(arms, scene)
        shown = [(arm, record) for arm in arms if (record := _record(arm, scene, seed)) is not None]
        keys = drawn_views(shown[0][1].folder / "pictures")[:VIEWS] if shown else []
        views += [view for key in keys if (view := _view(scene, seed, key, shown)) is not None]
    # A tag inside the text would end the script element.
    return json.dumps(views).replace("</", "<\\/") if views else None


def _seed_of_most(arms: Sequence[Arm], scene: str) -> int:
    seeds = sorted({record.summary.run.seed for arm in arms for record in arm.records})
    return max(seeds, key=lambda seed: sum(_record(arm, scene, seed) is not None for arm in arms))


def _record(arm: Arm, scene: str, seed: int) -> RunRecord | None:
    for record in arm.records:
        run = record.summary.run
        if (run.scene, run.seed) == (scene, seed) and run.split != "none":
            return record
    return None


def _view(
    scene: str, seed: int, key: tuple[int, int], shown: Sequence[tuple[Arm, RunRecord]]
) -> dict[str, object] | None:
    pictures = [(arm, record, picture_path(record.folder / "pictures", *key, "render")) for arm, record in shown]
    pictures = [(arm, record, path) for arm, record, path in pictures if path.is_file()]
    truth = picture_path(pictures[0][1].folder / "pictures", *key, "truth") if pictures else None
    if truth is None or not truth.is_file():
        return None
    images = [{"name": "truth", "label": "truth", "data": _embedded(truth)}]
    for arm, record, path in pictures:
        label = f"{arm.title}, {_psnr(record, key)}{record.summary.gaussians_total:,} Gaussians"
        images.append({"name": arm.title, "label": label, "data": _embedded(path)})
    return {"name": f"{scene}, seed {seed}, frame {key[0]}, camera {key[1]}", "images": images}


def _psnr(record: RunRecord, key: tuple[int, int]) -> str:
    images = QUALITY[record.summary.main_split].find(record.folder) or ()
    found = [image.regions["full"].psnr for image in images if (image.frame, image.camera) == key]
    return f"{found[0]:.2f} dB, " if found else ""


def _embedded(path: Path) -> str:
    with Image.open(path) as image:
        small = image.convert("RGB")
        if small.width > WIDTH:
            small = small.resize((WIDTH, round(small.height * WIDTH / small.width)), Image.Resampling.LANCZOS)
        buffer = io.BytesIO()
        small.save(buffer, "WEBP", quality=82)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
