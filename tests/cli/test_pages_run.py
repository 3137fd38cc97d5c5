"""Every command of the pages runs once: on tiny streets and runs, with tiny sizes (``page_commands.py``)."""

import importlib
import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from sparsestreet.bench import settings_sweep
from sparsestreet.cli.commands.export import export
from sparsestreet.cli.commands.train import train
from sparsestreet.scene.edits import objects_of
from sparsestreet.scene.storage import load_scene
from tests.cli.conftest import TIMED_ONCE, TINY_NODES, TINY_RIGID, method_of
from tests.cli.page_commands import NAMES, SHOWN, elsewhere, reader_of, words_of
from tests.conftest import unchecked
from tests.data.argoverse2.write import write_log
from tests.data.colmap.write import write_colmap
from tests.data.kitti.write import write_kitti
from tests.data.kitti360.write import write_kitti360
from tests.data.nerfstudio.write import write_nerfstudio
from tests.data.nuscenes.written import write_nuscenes
from tests.data.pandaset.write import write_sequence
from tests.data.plan import Plan
from tests.data.rig_json.write import write_rig
from tests.data.waymo.drive import Drive
from tests.data.waymo.records import write_drive
from tests.test_docs import ROOT

for extra in ("viser", "grpc", "pyarrow", "imageio_ffmpeg", "zstandard"):
    pytest.importorskip(extra, reason="pip install -e '.[dev]' brings what the commands of the pages need")

RUN_HERE = list(
    {
        tuple(words_of(one)): one.removeprefix("sparsestreet ")
        for one in SHOWN
        if elsewhere(one) is None and one.removeprefix("sparsestreet ") not in NAMES
    }.items()
)
"""Words and text of each command; those that differ by what stands in for the same run once."""
SMALL = [f"data.log.settings.{size}" for size in ("num_frames=8", "width=64", "height=40", "num_cameras=2")]
SWEPT = [*TIMED_ONCE, "seed=0", "schedule.max_steps=4", "trainer.val_check_interval=4"]
"""What makes a sweep smaller than +sweep=tiny has it."""

WRITERS: dict[str, Callable[[Path], object]] = {
    "argoverse2": write_log,
    "colmap": lambda root: write_colmap(root, Plan()),
    "kitti": lambda root: write_kitti(root, Plan()),
    "kitti360": write_kitti360,
    "nerfstudio": lambda root: write_nerfstudio(root, Plan()),
    "nuscenes": lambda root: write_nuscenes(root, Plan()),
    "pandaset": write_sequence,
    "rig_json": lambda root: write_rig(root, Plan()),
    "waymo": lambda root: write_drive(root, Drive(), "drive"),
}
"""Of each data set that a page names: a drive of four frames or so, in its files."""


@pytest.fixture(scope="module")
def place(finished, tiny_street, tmp_path_factory) -> Path:
    """The folder where a reader would type: DIR, runs, a file of edits, a scene in one file."""
    folder = tmp_path_factory.mktemp("pages")
    (root,) = (word.partition("=")[2] for word in tiny_street if word.startswith("data.log.root="))
    (folder / "DIR").symlink_to(root)
    shutil.copytree(finished, folder / "RUN")
    assert train([*tiny_street, *TINY_RIGID, "schedule.max_steps=2", f"out={folder / 'outputs' / 'plain'}"]) == 0
    assert export([str(folder / "RUN"), str(folder / "street.street")]) == 0
    for name in ("RUN", "A", "B", "demo/none", "demo/removal"):
        shutil.copytree(folder / "RUN", folder / "outputs" / name)
    (edits,) = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs" / "edit_and_drive.md").read_text(), flags=re.S)
    names = list(objects_of(load_scene(folder / "RUN").scene))
    (folder / "edits.yaml").write_text(edits.replace('"11"', f'"{names[0]}"').replace('"12"', f'"{names[1]}"'))
    return folder


def tiny(words: list[str], tiny_street: list[str]) -> list[str]:
    """What makes a training of these words tiny."""
    street = tiny_street
    if any(word.startswith(("data=", "data.root=")) for word in words):
        street = [word for word in street if not word.startswith("data.")]
        street += ["split.stride=0"] if reader_of(words) in WRITERS else []  # four frames
    elif any(word.startswith(("data.log.settings.", "seed=")) for word in words):
        street = ["data.log.parent=streets", *(word for word in street if not word.startswith("data.log.root="))]
    if {"image_points=none", "preset=drivestudio", "preset=drivestudio_legacy"} & set(words):  # no points from images
        street = [word for word in street if not word.startswith("image_points.")]
    return [*street, *TINY_NODES.get(method_of(words), [])]


def sized(name: str, words: list[str], tiny_street: list[str]) -> list[str]:
    """The words with tiny sizes."""
    if {"--help", "--cfg"} & set(words):
        return words
    if name == "train" and "+sweep=tiny" in words:
        return [*words, *SWEPT]
    if name == "train":
        steps = "schedule.max_steps=2" if "-m" in words else "trainer.fast_dev_run=2"
        return [*words, *tiny(words, tiny_street), steps]
    if name == "bench":
        options = tiny([], tiny_street) if "step" in words else []
        return [*(word for word in words if word != "quick=true"), "quick=true", *options]
    ports = [word for word in words if not word.startswith("port=")]
    return {
        "effects": [*words, *tiny(words, tiny_street)],
        "data": [*words, *(SMALL if "data=synthetic" in words else [])],
        "render": [*words, "frames=0:2", "fps=10"],
        "view": [*ports, "port=0"],
        "serve": words if "--proto" in words else [*ports, "port=0"],
    }.get(name, words)


def ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The viewer and the server, as if they were told to end as soon as they run."""
    from sparsestreet.viewing.server import Viewer

    run = Viewer.run

    def ended(viewer: Viewer) -> None:
        viewer.stop()
        run(viewer)
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "run", ended)
    monkeypatch.setattr(signal, "signal", lambda number, handler: handler(number, None))


def measures_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """What quick=true leaves long: compiled and interpreted kernels."""
    few = settings_sweep.points()[:2]
    monkeypatch.setattr(settings_sweep, "points", lambda: few)
    monkeypatch.setattr(settings_sweep, "backend_points", list)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The number of training batches")
@pytest.mark.parametrize("command", [words for words, _ in RUN_HERE], ids=[text[:70] for _, text in RUN_HERE])
def test_a_command_of_the_pages_runs(command, place, tiny_street, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(place)
    measures_little(monkeypatch)
    name, *words = command
    if name == "train" and not any(word.startswith(("out=", "-m", "+sweep=", "--")) for word in words):
        words = [*words, f"out={tmp_path / 'run'}"]  # two runs in one second would share a folder
    words = ["to=" + str(tmp_path / "OUT") if word == "to=OUT" else word for word in words]
    if (reader := reader_of(words)) in WRITERS:
        WRITERS[reader](tmp_path / "DIR")
        words = [word.replace("=DIR", f"={tmp_path / 'DIR'}") for word in words]
    if name in ("view", "serve"):
        ends_at_once(monkeypatch)
    if "sweep=outputs/sweeps/tiny" in words and not Path("outputs/sweeps/tiny").is_dir():
        assert train(["+sweep=tiny", *SWEPT]) == 0
    run = getattr(importlib.import_module(f"sparsestreet.cli.commands.{name}"), name)
    with unchecked():
        status = run(sized(name, words, tiny_street))
    assert status == 0 or name == "check", capsys.readouterr().err  # which asks whether a GPU can train here
    files = [word for word in words if name in ("render", "export") and re.fullmatch(r"[\w.]+\.\w+|\w+/", word)]
    assert all(Path(word).exists() for word in files)
