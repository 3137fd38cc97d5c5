"""Numbers of a scene file that size memory: each made huge, and refused in one line before memory is taken.

A process that may reserve little more than it holds opens the file, so that one which takes memory first says another
sentence.
"""

import shutil
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from sparsestreet.scene.effects import Effect
from sparsestreet.scene.effects.optics import MotionBlur, MotionBlurSettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene, load_scene, save_scene
from sparsestreet.scene.street_file import save_street
from tests.scene import test_storage_errors, test_street_file
from tests.scene.nodes import test_deformable, test_field
from tests.scene.stored import background, sky
from tests.stress.forked import Forked

MORE_MB = 400
FORMS = {
    ".safetensors": (
        save_scene,
        lambda path, change: test_storage_errors.rewritten(path, lambda told, _: change(told)),
    ),
    ".street": (save_street, lambda path, change: test_street_file.rewritten(path, lambda told: change(told["scene"]))),
}


def scene() -> StoredScene:
    nodes = {"field": test_field.street(), "walkers": test_deformable.objects(), "road": background(9, 0, sh_degree=1)}
    effects: dict[str, Effect] = {"sky": sky(), "blur": MotionBlur(MotionBlurSettings(when="on"), {}, 2)}
    return StoredScene(SceneGraph(nodes, effects), RenderOptions(), "claims", 5)


class Claim(NamedTuple):
    where: tuple[str, ...]
    value: int
    says: str
    """The invariant and the value."""


def of_network(name: str, value: int, node: str = "field") -> Claim:
    return Claim(
        ("nodes", node, "settings", "network", name), value, rf"are not those of NetworkSettings\(.*{name}={value}\b"
    )


CLAIMS = {
    "the width of a network": of_network("width", 50_000),
    "the width of an object's network": of_network("width", 50_000, "walkers"),
    "a width that is no number of 64 bits": Claim(
        ("nodes", "field", "settings", "network", "width"), 2**70, "is no scene file or is damaged|is no .street or is"
    ),
    "its depth": of_network("depth", 10**9),
    "octaves of positions": of_network("position_octaves", 10**8),
    "octaves of times": of_network("time_octaves", 10**8),
    "features of objects": Claim(
        ("nodes", "walkers", "settings", "features"), 10**9, r"embeddings have shape \(3, 3\), names.*\(3, 1000000000\)"
    ),
    "texels of the sky": Claim(("effects", "sky", "settings", "resolution"), 10**5, "its settings say .6, 100000"),
    "moments of an exposure": Claim(("effects", "blur", "header", "moments"), 10**5, "1 to 5 moments, got 100000"),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a file of each form that opens."""
    folder = tmp_path_factory.mktemp("claims")
    for form, (save, _) in FORMS.items():
        save(folder / f"scene{form}", scene())
        load_scene(folder / f"scene{form}")
    return folder


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("claim", CLAIMS.values(), ids=CLAIMS)
def test_a_claim(claim: Claim, form: str, sound: Path, tmp_path: Path):
    path = Path(shutil.copy(sound / f"scene{form}", tmp_path))

    def change(told: dict) -> None:
        for key in claim.where[:-1]:
            told = told[key]
        assert claim.where[-1] in told
        told[claim.where[-1]] = claim.value

    FORMS[form][1](path, change)
    ended = Forked(lambda: _refused(path, claim.says), tmp_path / "log", more_mb=MORE_MB).join(60)
    assert ended.status == 0, ended.said


def _refused(path: Path, says: str) -> None:
    with pytest.raises(ValueError, match=rf"^[^\n]*{says}[^\n]*$"):
        load_scene(path)


def test_harmonics_of_no_degree(sound: Path, tmp_path: Path):
    """A table of their squared number would be made when the scene is packed."""
    path = Path(shutil.copy(sound / "scene.safetensors", tmp_path))

    def change(_: dict, tensors: dict) -> None:
        tensors["nodes.road.rows.sh_rest"] = torch.zeros(9, 30_000, 3)

    test_storage_errors.rewritten(path, change)
    with pytest.raises(ValueError, match=r"0, 3, 8 or 15 x 3 harmonics above the first, got \(30000, 3\)"):
        load_scene(path)
