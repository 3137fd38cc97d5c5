"""Scenes by name, and which of them are open."""

import shutil
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from sparsestreet.scene.effects import LensSettings, ShutterSettings
from sparsestreet.scene.effects.optics import GlobalShutter, Pinhole
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.storage import load_scene
from sparsestreet.scene.street_file import ATTACHED, save_street
from sparsestreet.serving.renderer import Scenes, UnknownSceneError, named_runs
from tests.serving.street import write_run


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    first = write_run(root / "a")
    return [first, *(shutil.copytree(first, root / name) for name in "bc")]


def test_the_scene_asked_for_longest_ago_is_closed_where_memory_ends(folders):
    size, opened = (folders[0] / "scene.safetensors").stat().st_size, []

    def open_scene(run):
        opened.append(run.name)
        return load_scene(run)

    scenes = Scenes(named_runs(folders), open_scene, memory=2 * size)
    for name in "abaca":
        assert scenes.get(name).name == name
    assert opened == ["a", "b", "c"]
    assert scenes.opened == ["c", "a"]
    scenes.get("b")
    assert scenes.opened == ["a", "b"]


def test_one_scene_is_open_however_little_memory_there_is_and_read_once_by_many(folders):
    opened = []

    def open_scene(run):
        opened.append(run.name)
        time.sleep(0.05)  # long enough for the others to ask
        return load_scene(run)

    scenes = Scenes(named_runs(folders), open_scene, memory=1)
    with ThreadPoolExecutor(4) as pool:
        assert len({id(one) for one in pool.map(lambda _: scenes.get("b"), range(8))}) == 1
    assert opened == ["b"]
    assert scenes.rig("c").cameras[0].name == "0"
    assert scenes.opened == ["b"]


def test_a_street_is_served_like_a_folder(folders, tmp_path):
    attached = {name: (folders[0] / name).read_bytes() for name in ATTACHED if (folders[0] / name).is_file()}
    save_street(tmp_path / "town.street", load_scene(folders[0]), attached)
    scenes = Scenes(named_runs([tmp_path / "town.street", folders[1]]), load_scene, memory=1)
    assert scenes.names == ["town", "b"]
    assert [one.name for one in scenes.rig("town").cameras] == [one.name for one in scenes.rig("b").cameras]
    assert scenes.get("town").stored.scene.counts() == scenes.get("b").stored.scene.counts()


def test_names_that_are_no_scene(folders):
    scenes = Scenes(named_runs(folders), load_scene, memory=1)
    with pytest.raises(UnknownSceneError, match="no scene 'd': this server has a, b, c"):
        scenes.get("d")
    with pytest.raises(UnknownSceneError, match=r"no scene '\*'"):
        scenes.get("*")  # which of the three?
    with pytest.raises(ValueError, match="scene_id is empty"):
        scenes.rig("")


def test_folders_that_cannot_be_served(folders, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"scene\.safetensors"):
        named_runs([tmp_path])
    with pytest.raises(ValueError, match="name of its own, got a, a"):
        named_runs([folders[0], folders[0]])


def test_lens_and_shutter_of_a_request_count_also_where_training_left_them_out(folders):
    def without(run):
        stored = load_scene(run)
        effects = {
            "lens": Pinhole(LensSettings(when="off", learning_rates={})),
            "shutter": GlobalShutter(ShutterSettings(when="off", learning_rates={})),
        }
        graph = SceneGraph(dict(stored.scene.nodes.items()), dict(stored.scene.effects.items()) | effects)
        return type(stored)(graph, stored.options, stored.name, stored.num_frames)

    scenes = Scenes(named_runs(folders), without, memory=10**9)
    assert list(scenes.get("a").stored.scene.effects) == ["sky"]
