"""Hulls of objects whose shapes are known, and the .obj that has them where they are."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from sparsestreet.export import shapes as module
from sparsestreet.export.shapes import Hull, object_hull, write_shapes
from sparsestreet.geometry.meshes import Mesh
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Rigid, Tracked
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.state import FINISHED
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import View
from tests.export.street import CAR_ROWS, stored_street, street_views
from tests.scene.people import smpl, walker
from tests.scene.street import random_rows, rigid

TURN = Rotation.from_euler("zyx", [2.0, 0.1, -0.2])
CENTER = np.array([31.0, -8.0, 2.5])


def block(opacity: float = 2.0) -> Rigid:
    """A box of 4 x 2 x 1.5 m, turned; opaque Gaussians in it reach 1.7, 0.7 and 0.5 m from its middle, one leaves it
    above and one far ahead, and faint ones are everywhere."""
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
    rows = random_rows(30, 3, instances=torch.zeros(30, dtype=torch.int64))
    with torch.no_grad():
        rows.means[:8] = torch.from_numpy(signs * [1.6, 0.6, 0.4]).float()
        rows.means[8] = torch.tensor([0.0, 0.0, 0.7])
        rows.means[9] = torch.tensor([2.6, 0.0, 0.0])
        rows.log_scales[:] = torch.tensor([0.1, 0.1, 0.1]).log()
        rows.log_scales[8] = torch.tensor([0.01, 0.01, 0.3]).log()
        rows.quaternions[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        rows.opacity_logits[:10], rows.opacity_logits[10:] = opacity, -0.1
    x, y, z, w = TURN.as_quat()
    keyframes = Trajectories(
        torch.tensor([[0.0, 1.0]]),
        torch.tensor([w, x, y, z]).float().repeat(1, 2, 1),
        torch.from_numpy(CENTER).float().repeat(1, 2, 1),
        torch.ones(1, 2, dtype=torch.bool),
        torch.tensor([[0.0, 1.0]]),
    )
    return rigid(rows, keyframes, torch.tensor([[4.0, 2.0, 1.5]]))


def hull_at_start(node: Tracked) -> Hull:
    with torch.no_grad():
        gaussians = node.gaussians_at(View(street_views()[0].camera, 0.0, 0, 0), FINISHED)
    return object_hull(gaussians, node, 0, node.object_frames(node.pose_at(0.0))[0])


def test_a_hull_is_around_what_is_opaque_and_within_the_box():
    node = block()
    found = hull_at_start(node)
    assert not found.is_box
    expected = [[x * 1.6, y * 0.6, z * 0.4] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    expected = np.concatenate([np.array(expected) + side * step for side in (-1, 1) for step in np.diag([0.1] * 3)])
    ends = [[0, 0, 0.75], [2.0, 0.1, 0], [2.0, -0.1, 0], [2.0, 0, 0.1], [2.0, 0, -0.1]]
    by_hand = ConvexHull(np.concatenate([expected, ends]))
    assert ConvexHull(found.mesh.vertices).volume == pytest.approx(by_hand.volume, rel=1e-4)
    np.testing.assert_allclose(found.mesh.vertices.max(0), [2.0, 0.7, 0.75], atol=1e-5)
    np.testing.assert_allclose(found.mesh.vertices.min(0), [-1.7, -0.7, -0.5], atol=1e-5)


@pytest.mark.parametrize("people", [False, True])
def test_an_object_of_faint_gaussians_is_its_box(people):
    """A person's frame is at the pelvis, the box from the soles up."""
    node = smpl(walker(height=1.6)) if people else block(opacity=-1.0)
    with torch.no_grad():
        node.rows.opacity_logits.fill_(-1.0)
    found = hull_at_start(node)
    assert found.is_box
    assert len(found.mesh.vertices) == 8
    length, width, height = node.sizes[0].tolist()
    soles = -node.frame_height(0)
    np.testing.assert_allclose(found.mesh.vertices.min(0), [-length / 2, -width / 2, soles], atol=1e-6)
    np.testing.assert_allclose(found.mesh.vertices.max(0), [length / 2, width / 2, soles + height], atol=1e-6)
    assert people == (abs(2 * soles + height) > 0.01)


def read_obj(path: Path) -> dict[str, Mesh]:
    text, found = path.read_text(), {}
    vertices = np.array(re.findall(r"^v (\S+) (\S+) (\S+)$", text, flags=re.M), dtype=float)
    for part in re.split(r"^o ", text, flags=re.M)[1:]:
        faces = np.array(re.findall(r"^f (\d+) (\d+) (\d+)$", part, flags=re.M), dtype=int) - 1
        used, rows = np.unique(faces, return_inverse=True)
        found[part.split("\n")[0]] = Mesh(vertices[used], rows.reshape(-1, 3))
    return found


def test_an_obj_has_what_is_there_where_it_is(tmp_path):
    """The tram is there up to half of the time; the random road of this street tells no ground."""
    stored, views = stored_street(), street_views()
    shapes = write_shapes(tmp_path / "a.obj", stored, views, 0.25)
    assert (shapes.ground, shapes.hulls) == (None, ("car", "tram"))
    found = read_obj(tmp_path / "a.obj")
    assert list(found) == ["car", "tram"]
    for name, center in ("car", [9.0, 0.5, 1.0]), ("tram", [9.0, 0.0, 1.0]):
        assert (np.abs(found[name].vertices - center) <= 0.5001).all()
    assert write_shapes(tmp_path / "b.obj", stored, views, 1.0).hulls[:1] == ("car",)
    with torch.no_grad():
        stored.scene.nodes["rigid"].rows.opacity_logits[:CAR_ROWS] = -3.0
    assert write_shapes(tmp_path / "b.obj", stored, views, 0.25).boxes == ("car",)
    turned = StoredScene(SceneGraph({"block": block()}), RenderOptions(), "x", 5)
    write_shapes(tmp_path / "c.obj", turned, views, 0.0)
    (mesh,) = read_obj(tmp_path / "c.obj").values()
    own = (mesh.vertices - CENTER) @ TURN.as_matrix()
    np.testing.assert_allclose(own.max(0), [2.0, 0.7, 0.75], atol=2e-4)  # four decimals


def test_an_obj_with_surroundings_has_them_beside_ground_and_hulls(tmp_path, monkeypatch):
    """They are of the views and the voxel that are asked for; without a voxel there are none."""
    stored, views = stored_street(), street_views()
    around = Mesh(np.array([[1.0, 0, 0], [2, 0, 0], [1, 1, 3]]), np.array([[0, 1, 2]]))
    asked = []
    monkeypatch.setattr(module, "surroundings", lambda *given: asked.append(given) or around)
    shapes = write_shapes(tmp_path / "a.obj", stored, views, 0.25, voxel=0.3)
    assert asked == [(stored.scene, views, stored.options, 0.3)]
    assert shapes.surroundings is around
    assert shapes.hulls == ("car", "tram")
    found = read_obj(tmp_path / "a.obj")
    assert list(found) == ["surroundings", "car", "tram"]
    np.testing.assert_allclose(found["surroundings"].vertices, around.vertices)
    write_shapes(tmp_path / "b.obj", stored, views, 0.25)
    assert len(asked) == 1
    with torch.no_grad():
        stored.scene.nodes["background"].rows.means[3, 1] = torch.nan
    with pytest.raises(ValueError, match=r"means.*nan"):
        write_shapes(tmp_path / "c.obj", stored, views, 0.25, voxel=0.3)
    assert not (tmp_path / "c.obj").exists()


def test_an_obj_of_nothing_is_an_error(tmp_path):
    stored = stored_street()
    empty = StoredScene(stored.scene.without("rigid"), stored.options, "x", 5)
    with pytest.raises(ValueError, match="nothing tells where the ground is, and no object is there"):
        write_shapes(tmp_path / "a.obj", empty, street_views(), 0.0)
    with pytest.raises(ValueError, match="time runs from 0"):
        write_shapes(tmp_path / "a.obj", stored, street_views(), 1.5)
    assert not list(tmp_path.iterdir())
