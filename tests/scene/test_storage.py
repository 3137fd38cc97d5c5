"""A scene file opens by itself and shows the same, bit for bit."""

import json
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import sparsestreet
from sparsestreet.ops import SplatSettings
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.scene.storage import SCENE_FILE, StoredScene, load_scene, save_scene
from tests.scene.stored import NAMES, background, cars, pixels, stored, view, with_nodes

TIMES = [0.0, 0.25, 0.37, 1.0]


def reopened(path: Path, scene: StoredScene) -> StoredScene:
    save_scene(path / SCENE_FILE, scene)
    return load_scene(path / SCENE_FILE)


def header_of(path: Path) -> dict:
    """The file's own description, read by hand: a length of 8 bytes, then JSON."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    outer = json.loads(content[8 : 8 + length])
    return json.loads(outer["__metadata__"]["sparsestreet"], parse_constant=pytest.fail)


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_the_image_is_the_same_bit_for_bit(tmp_path: Path, sh_degree: int):
    scene = stored(sh_degree)
    loaded = reopened(tmp_path, scene)
    for time in TIMES:
        expected = pixels(scene.render(view(time)))
        assert all(map(torch.equal, pixels(loaded.render(view(time))), expected))
        assert expected[1].max() > 0.5
    assert not loaded.render(view()).rgb.requires_grad
    assert not any(module.training for module in loaded.scene.modules())
    assert loaded.render(view()).spans == {"road": slice(0, 30), "trees": slice(30, 39), "cars": slice(39, 47)}


def test_everything_that_is_said_comes_back(tmp_path: Path):
    scene = stored()
    loaded = reopened(tmp_path, scene)
    assert (loaded.name, loaded.num_frames, loaded.options) == ("hand-made", 5, scene.options)
    assert loaded.options != RenderOptions()
    for name, node in scene.scene.nodes.items():
        again = loaded.scene.nodes[name]
        assert type(again) is type(node)
        # A tuple of classes comes back as a list.
        assert replace(again.settings, classes=tuple(again.settings.classes)) == node.settings
    assert loaded.scene.effects["sky"].settings == scene.scene.effects["sky"].settings
    assert loaded.scene.nodes["cars"].instances().names == tuple(NAMES)
    assert loaded.scene.nodes["cars"].max_gap == 0.61
    state = scene.scene.state_dict()
    assert loaded.scene.state_dict().keys() == state.keys()
    assert all(torch.equal(value, state[name]) for name, value in loaded.scene.state_dict().items())


def test_a_loaded_scene_can_be_trained_on(tmp_path: Path):
    scene = reopened(tmp_path, stored()).scene
    render(scene, view()).rgb.sum().backward()
    means = [node.rows.means for node in scene.nodes.values()]
    assert all((mean.grad != 0).any() for mean in means)
    assert scene.learning_rates().keys() == {name for name, _ in scene.named_parameters()}


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_masks_that_are_being_trained_have_done_their_work_in_the_file(tmp_path: Path, sh_degree: int):
    scene = stored(sh_degree, masked=True)
    before = {name: value.clone() for name, value in scene.scene.state_dict().items()}
    expected = pixels(scene.render(view()))
    loaded = reopened(tmp_path, scene)
    kept = {name: node.mask.keep(node.rows).keep for name, node in scene.scene.nodes.items()}
    assert loaded.scene.counts() == {name: int(keep.sum()) for name, keep in kept.items()}
    assert all(0 < int(keep.sum()) < len(keep) for keep in kept.values())
    for name, node in loaded.scene.nodes.items():
        assert node.mask is None
        assert "mask_logits" not in node.rows.columns()
        assert torch.equal(node.rows.means, scene.scene.nodes[name].rows.means[kept[name]])
    assert all(map(torch.equal, pixels(loaded.render(view())), expected))
    # The scene itself goes on training with its masks.
    after = scene.scene.state_dict()
    assert after.keys() == before.keys()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert all(node.mask is not None for node in scene.scene.nodes.values())


def test_rows_that_the_floor_holds_are_in_the_file(tmp_path: Path):
    scene = stored(masked=True)
    road = scene.scene.nodes["road"]
    with torch.no_grad():
        road.rows.mask_logits.copy_(-5 - torch.rand(30, generator=torch.Generator().manual_seed(7)))
    expected = pixels(scene.render(view()))
    loaded = reopened(tmp_path, scene)
    assert loaded.scene.counts()["road"] == road.settings.min_gaussians == 12
    assert all(map(torch.equal, pixels(loaded.render(view())), expected))


def test_nodes_without_rows_and_a_scene_without_sky(tmp_path: Path):
    scene = with_nodes(stored(), road=background(0, 0, sh_degree=3), cars=cars(0), trees=background(4, 1, sh_degree=0))
    del scene.scene.effects["sky"]
    loaded = reopened(tmp_path, scene)
    assert loaded.scene.counts() == {"road": 0, "cars": 0, "trees": 4}
    assert dict(loaded.scene.effects.items()) == {}
    assert loaded.scene.nodes["cars"].instances().names == tuple(NAMES)
    assert all(map(torch.equal, pixels(loaded.render(view())), pixels(scene.render(view()))))


@pytest.mark.parametrize(
    "settings",
    [
        SplatSettings(),  # max_sigma is infinite, which JSON does not know
        SplatSettings(alpha_min=0.1 + 0.2, transmittance_min=1e-300, eps2d=1 / 3, stop="exclusive", antialias=True),
    ],
)
def test_options_come_back_to_the_last_bit(tmp_path: Path, settings: SplatSettings):
    options = RenderOptions(settings, "reference")
    assert reopened(tmp_path, replace(stored(), options=options)).options == options
    # Other programs read the header, too: no NaN and no Infinity in it.
    assert header_of(tmp_path / SCENE_FILE)["num_frames"] == 5


def test_the_scene_goes_to_the_device_that_is_asked_for(tmp_path: Path):
    save_scene(tmp_path / SCENE_FILE, stored())
    scene = load_scene(tmp_path, "meta").scene  # a device that every machine has
    tensors = [*scene.parameters(), *scene.buffers()]
    assert {tensor.device.type for tensor in tensors} == {"meta"}
    assert scene.device == torch.device("meta")


def test_a_run_folder_stands_for_its_scene(tmp_path: Path):
    scene = stored()
    save_scene(tmp_path / "runs" / "first" / SCENE_FILE, scene)
    assert [path.name for path in (tmp_path / "runs" / "first").iterdir()] == ["scene.safetensors"]
    loaded = sparsestreet.load_scene(str(tmp_path / "runs" / "first"))
    assert all(map(torch.equal, pixels(loaded.render(view())), pixels(scene.render(view()))))


def test_a_file_is_written_again_over_the_old_one(tmp_path: Path):
    save_scene(tmp_path / SCENE_FILE, stored())
    first = (tmp_path / SCENE_FILE).read_bytes()
    loaded = reopened(tmp_path, replace(stored(3), name="another"))
    assert loaded.name == "another"
    assert loaded.scene.nodes["road"].rows.sh_rest.shape == (30, 15, 3)
    # The same scene is the same file.
    save_scene(tmp_path / SCENE_FILE, stored())
    assert (tmp_path / SCENE_FILE).read_bytes() == first


IN_A_NEW_PROCESS = """
import sys
import torch
import sparsestreet
from sparsestreet.types import Camera, View

given = torch.load(sys.argv[2])
scene = sparsestreet.load_scene(sys.argv[1])
camera = Camera(given["camera_from_world"], given["intrinsics"], given["width"], given["height"])
images = [scene.render(View(camera, time)) for time in given["times"]]
torch.save([(image.rgb, image.alpha, image.depth) for image in images], sys.argv[3])
"""


@pytest.mark.lengthy
@pytest.mark.parametrize("backend", ["auto", pytest.param("reference", marks=pytest.mark.slow)])
def test_a_new_process_shows_the_same_from_a_folder_that_was_moved(tmp_path: Path, backend: str):
    """Nothing but the file: no log, no configuration, no folder that it was written in."""
    scene = replace(stored(3, masked=True), options=RenderOptions(SplatSettings(eps2d=0.31), backend))
    save_scene(tmp_path / "written" / SCENE_FILE, scene)
    camera = vars(view().camera) | {"times": TIMES}
    torch.save({k: v for k, v in camera.items() if v is not None}, tmp_path / "camera.pt")
    (tmp_path / "written").rename(tmp_path / "moved")
    places = [str(tmp_path / name) for name in ("moved", "camera.pt", "images.pt")]
    command = [sys.executable, "-W", "error", "-c", IN_A_NEW_PROCESS, *places]
    subprocess.run(command, check=True, cwd=tmp_path)
    for time, images in zip(TIMES, torch.load(tmp_path / "images.pt"), strict=True):
        assert all(map(torch.equal, images, pixels(scene.render(view(time)))))
