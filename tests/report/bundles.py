"""Bundles for tests: of two runs with numbers that tests choose, and what somebody may do to one."""

import hashlib
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from sparsestreet.records.summary import HELD_OUT, QUALITY, SUMMARY, RunSummary, camera_means, summarize
from sparsestreet.report.bundle import write_bundle
from sparsestreet.report.collect import collect
from tests.evaluation.frames import make_image, make_summary

AWAY = {"command": "sparsestreet train data.root=/home/me/drive seed=0", "config": {"data.root": "/home/me/drive"}}
"""Of a machine whose folders are nobody else's business."""


def write_run(folder: Path, summary: RunSummary, *psnr: float) -> Path:
    """A run whose record has the means of its images."""
    images = [make_image(5, camera, psnr=value) for camera, value in enumerate(psnr)]
    quality, cameras = {HELD_OUT: summarize(images)}, {HELD_OUT: camera_means(images)}
    SUMMARY.write(folder, replace(summary, quality=quality, by_camera=cameras, images={HELD_OUT: len(images)}))
    QUALITY[HELD_OUT].write(folder, images)
    return folder


def two_runs(folder: Path) -> Path:
    write_run(folder / "a", make_summary("streetgs", 0, **AWAY), 24.123456, 25.2, 27.9)
    write_run(folder / "b", make_summary("streetgs+paper", 0, gaussians={"background": 77}, **AWAY), 23.0, 24.5)
    return folder


def bundled(folder: Path, path: Path) -> Path:
    write_bundle(collect([folder]), path, protocol="drivestudio", baseline="streetgs")
    return path


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def changed(path: Path, name: str, change: Callable[[str], str], rehash: bool = True) -> Path:
    """The bundle with a member changed, and with its hash as well if somebody thought of that."""
    found = members(path)
    before = found[name].decode()
    found[name] = change(before).encode()
    assert found[name] != before.encode(), f"{name} is as it was"
    if rehash:
        old, new = (hashlib.sha256(text).hexdigest() for text in (before.encode(), found[name]))
        found["bundle.json"] = found["bundle.json"].replace(old.encode(), new.encode())
    return packed(path, found)


def packed(path: Path, found: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in found.items():
            archive.writestr(name, content)
    return path


def with_entry(text: str, *keys: str, value: object) -> str:
    """A JSON text with another value at a place."""
    tree = json.loads(text)
    place = tree
    for key in keys[:-1]:
        place = place[int(key) if isinstance(place, list) else key]
    assert keys[-1] in place
    place[keys[-1]] = value
    return json.dumps(tree)
