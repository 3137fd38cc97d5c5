"""Files that are cut short, empty or have flipped bits: refused in one line, or survived with a warning."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from sparsestreet.training.callbacks.files import step_of
from sparsestreet.triangulation import street
from tests.cli.test_killed_sweep import content
from tests.data.damage import Damage, cut, written
from tests.stress.forked import command
from tests.stress.runs import (
    MORE_MB,
    SHORT,
    assert_nothing_half_written,
    assert_refused,
    assert_survived,
    contents,
    cut_short,
    on_drive,
    street_of,
)
from tests.triangulation.test_street import POINTS, _get

empty = written(b"")


def flipped(bits: int, seed: int = 7) -> Damage:
    """So many bits, anywhere."""

    def damage(path: Path) -> None:
        broken, source = bytearray(path.read_bytes()), random.Random(seed)
        for _ in range(bits):
            broken[source.randrange(len(broken))] ^= 1 << source.randrange(8)
        path.write_bytes(broken)

    return damage


class Case(NamedTuple):
    file: str
    damage: Damage
    says: str


DRIVES = {
    "half an image": Case("images/003_0.jpg", cut, "the image cannot be decoded"),
    "an empty image": Case("images/004_1.jpg", empty, "the image cannot be decoded"),
    "an image of text": Case("images/003_1.jpg", written(b"no image" * 99), "the image cannot be decoded"),
    "half a mask of the sky": Case("sky_masks/003_0.png", cut, "the image cannot be decoded"),
    "flipped bits in a mask of the sky": Case("sky_masks/005_0.png", flipped(8), "the image cannot be decoded"),
    "an empty mask of vehicles": Case("dynamic_masks/vehicle/003_0.png", empty, "the image cannot be decoded"),
    "half a sweep": Case("lidar/004.bin", cut, "are no whole number of rows"),
    "flipped bits in a sweep": Case("lidar/004.bin", flipped(4000), "points are NaN, infinite or more than"),
    "half a pose of the lidar": Case("lidar_pose/004.txt", cut, "a pose is a 4x4 matrix"),
    "an empty pose of a camera": Case("extrinsics/003_1.txt", empty, "a pose is a 4x4 matrix"),
    "flipped bits in a pose": Case("extrinsics/003_1.txt", flipped(20), "is no table of numbers"),
    "half a calibration": Case("intrinsics/1.txt", cut, "a camera has 9 numbers"),
    "half of the boxes": Case("instances/instances_info.json", cut, "the file is no JSON"),
    "no list of boxes": Case("instances/frame_instances.json", empty, "the file is no JSON"),
    "half of the stamps": Case("timestamps.txt", cut, "a log of 12 frames has 12 stamps"),
    "half of the people": Case("humanpose/smpl.pkl", cut, "must be a pickle of plain values"),
}
"""Of a drive that is to be trained."""


def torn(path: Path) -> None:
    """Cut a YAML file and open a bracket: half of one may be whole, by chance."""
    cut(path)
    path.write_text(path.read_text(encoding="utf-8") + "\n{[", encoding="utf-8")


EVALUATE, RENDER, EXPORT = ("evaluate", "{run}"), ("render", "{run}", "{out}/a.mp4"), ("export", "{run}", "{out}/a.ply")
RUNS = {
    "half a description": (EVALUATE, Case("run.json", cut, "run.json: is not strict JSON")),
    "an empty configuration": (EVALUATE, Case(".hydra/config.yaml", empty, "its configuration lacks 'evaluation'")),
    "half a configuration": (EVALUATE, Case(".hydra/config.yaml", torn, "/.hydra/config.yaml is ")),
    "no word of its start": (EVALUATE, Case(".hydra/hydra.yaml", empty, "hydra.yaml is damaged")),
    "half a scene": (EVALUATE, Case("scene.safetensors", cut, "is no scene file or is damaged")),
    "an empty scene": (RENDER, Case("scene.safetensors", empty, "is no scene file or is damaged")),
    "flipped bits in views": (RENDER, Case("views.json", flipped(40), "views.json: cannot be read")),
    "half of the views": (RENDER, Case("views.json", cut, "views.json: is not strict JSON")),
    "half a record": (("report", "{run}"), Case("records/summary.json", cut, "summary.json: is not strict JSON")),
    "half a file of edits": ((*EXPORT, "edits={run}/edits.yaml"), Case("edits.yaml", cut, "edits.yaml is no YAML")),
    "bits in edits": ((*RENDER, "edits={run}/edits.yaml"), Case("edits.yaml", flipped(20), "edits.yaml is no YAML")),
    "half a path": ((*RENDER, "path={run}/path.json"), Case("path.json", cut, "path.json is no JSON")),
}
"""Of a run that is finished."""
UNFINISHED = {
    "half a checkpoint": Case("checkpoints/last.ckpt", cut, "is no checkpoint of a training"),
    "an empty checkpoint": Case("checkpoints/last.ckpt", empty, "is no checkpoint of a training"),
    "flipped bits in a checkpoint": Case("checkpoints/last.ckpt", flipped(40), "is no checkpoint of a training"),
    "a description of an unfinished run": Case("run.json", flipped(200), "run.json: cannot be read"),
    "flipped bits in curves": Case("curves/metrics.csv", flipped(400), "metrics.csv: cannot be read"),
    "a configuration": Case(".hydra/config.yaml", cut, "holds another run"),
}
"""Of a run that the same command goes on with."""
CACHES = {"half a cache": cut, "an empty cache": empty, "flipped bits in a cache": flipped(40)}


@pytest.fixture(scope="module")
def finished(tiny_street, tmp_path_factory) -> tuple[list[str], Path]:
    """Words of a run, and its folder."""
    folder = tmp_path_factory.mktemp("damaged")
    words = ["train", *tiny_street, *SHORT, f"cache={folder / 'kept'}"]
    ended = command([*words, f"out={folder / 'run'}"], folder / "log")
    assert ended.status == 0, ended.said
    (folder / "run/edits.yaml").write_text("move:\n  car_1: {right: 3.0, during: [1.0, 3.0]}\n")
    (folder / "run/path.json").write_text('{"poses": [{"seconds": 0.0, "world_from_camera": [[1, 0, 0, 0]]}]}')
    return words, folder / "run"


@pytest.mark.stress
@pytest.mark.parametrize("case", DRIVES.values(), ids=DRIVES)
def test_a_drive(case, tiny_street, tmp_path):
    shutil.copytree(street_of(tiny_street), tmp_path / "drive")
    case.damage(tmp_path / "drive" / case.file)
    ended = command(on_drive(tmp_path / "drive", tmp_path / "out"), tmp_path / "log", more_mb=MORE_MB)
    assert_refused(ended, case.says)
    assert case.file in ended.lines[-1]
    assert not (tmp_path / "out").exists()


def check_run(words: tuple[str, ...], case: Case, whole: Path, folder: Path) -> None:
    run, out = folder / "run", folder / "out"
    shutil.copytree(whole, run)
    out.mkdir()
    case.damage(run / case.file)
    before = contents(run)
    ended = command([word.format(run=run, out=out) for word in words], folder / "log", more_mb=MORE_MB)
    assert_refused(ended, case.says)
    assert contents(run) == before
    assert list(out.iterdir()) == []


@pytest.mark.stress
@pytest.mark.parametrize(("words", "case"), RUNS.values(), ids=RUNS)
def test_a_finished_run(words, case, finished, tmp_path):
    check_run(words, case, finished[1], tmp_path)


@pytest.mark.stress
@pytest.mark.parametrize("case", UNFINISHED.values(), ids=UNFINISHED)
def test_an_unfinished_run(case, finished, tmp_path):
    """Nothing that is whole is lost."""
    words, whole = finished
    run = tmp_path / "run"
    cut_short(whole, run)
    case.damage(run / case.file)
    before = contents(run)
    ended = command([*words, f"out={run}"], tmp_path / "log", more_mb=MORE_MB)
    assert_refused(ended, case.says)
    assert contents(run) == before
    assert_nothing_half_written(run)


@pytest.mark.stress
@pytest.mark.parametrize("damage", CACHES.values(), ids=CACHES)
def test_a_cache(damage: Callable[[Path], object], finished, tmp_path):
    """The same records, and a cache that is whole again."""
    words, whole = finished
    (cache,) = (whole.parent / "kept").glob("points-*")
    files = set(cache.parent.iterdir())
    sound, run = cache.read_bytes(), tmp_path / "run"
    damage(cache)
    try:
        ended = command([*words, f"out={run}"], tmp_path / "log", more_mb=MORE_MB)
        assert_survived(ended, f"{cache} is damaged")
        assert cache.read_bytes() == sound
        assert set(cache.parent.iterdir()) == files
    finally:
        cache.write_bytes(sound)
    got, expected = content(run), content(whole)
    assert [name for name in got if got[name] != expected.get(name)] == []


@pytest.mark.lengthy
def test_a_checkpoint_in_short(tmp_path):
    """Wherever a bit is flipped: torch's own reading notices few of them."""
    sound, path = tmp_path / "sound.ckpt", tmp_path / "last.ckpt"
    torch.save({"global_step": 7, "means": torch.arange(3000.0)}, sound)
    assert step_of(sound) == 7
    for damage in (cut, empty, *(flipped(1, seed) for seed in range(20))):
        shutil.copy(sound, path)
        damage(path)
        try:
            assert step_of(path) == 7
        except ValueError as error:
            assert "is no checkpoint of a training" in str(error)  # noqa: PT017 (some bits mean nothing)
            continue
        found, whole = (torch.load(file, weights_only=True)["means"] for file in (path, sound))
        assert torch.equal(found, whole)


@pytest.mark.lengthy
@pytest.mark.parametrize("damage", CACHES.values(), ids=CACHES)
def test_a_cache_in_short(damage, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(street, "street_points", lambda *inputs: POINTS)
    _get(tmp_path)
    (path,) = tmp_path.iterdir()
    sound = path.read_bytes()
    damage(path)
    assert _get(tmp_path) is POINTS
    assert f"{path} is damaged" in caplog.text
    assert path.read_bytes() == sound
