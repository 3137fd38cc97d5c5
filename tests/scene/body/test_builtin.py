import pytest
import torch

from sparsestreet.geometry.skeleton import JOINTS, rest_joints
from sparsestreet.scene.body import BodyTemplate, BuiltinBody, surface
from tests.weighed import weighed

NUM_VERTICES = pytest.mark.parametrize("num_vertices", [700, pytest.param(6000, marks=pytest.mark.lengthy)])


def edges_of(template: BodyTemplate) -> torch.Tensor:
    return torch.cat([template.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])


@pytest.mark.lengthy
@NUM_VERTICES
def test_it_is_one_closed_surface(num_vertices):
    template = BuiltinBody(num_vertices).load()
    assert abs(len(template.vertices) - num_vertices) < 0.1 * num_vertices
    edges = edges_of(template)
    # Each edge is run through once in either direction, and a surface like a sphere has V - E + F = 2.
    assert len(edges.unique(dim=0)) == len(edges)
    assert torch.equal(edges.unique(dim=0), edges.flip(1).unique(dim=0))
    assert len(template.vertices) - len(edges) // 2 + len(template.faces) == 2


@NUM_VERTICES
def test_it_has_the_size_of_a_person(num_vertices):
    template = BuiltinBody(num_vertices).load()
    assert template.height == pytest.approx(1.75, abs=0.02)
    a, b, c = template.vertices[template.faces].unbind(1)
    volume = float((a * torch.linalg.cross(b, c)).sum() / 6)
    # 75 kg at the density of water, and the surface of an adult; a positive volume has its triangles outwards.
    assert 0.055 < volume < 0.095
    areas, normals = surface(template.vertices, template.faces)
    assert 1.5 < float(areas.sum()) < 2.2
    assert float(areas.min()) > 0
    torch.testing.assert_close(areas.sum(), torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2)
    crown, soles = template.vertices[:, 1].argmax(), template.vertices[:, 1].argmin()
    assert float(normals[crown, 1]) > 0.9
    assert float(normals[soles, 1]) < -0.9
    assert torch.equal(template.joints, rest_joints())
    assert float(template.vertices[:, 2].amax()) > 0.15  # the toes point forward


def test_it_stays_as_it_is():
    """People of a scene file stand on it: their vertices are not in the file."""
    template = BuiltinBody().load()
    assert template.vertices.dtype == template.joints.dtype == template.weights.dtype == torch.float32
    found = (weighed(template.vertices), weighed(template.faces), weighed(template.joints), weighed(template.weights))
    # Slopes are taken over 0.1 mm: of 2,000 coordinates few are off by more than a micrometer.
    assert found == pytest.approx((316.7012, 681586.197, 11.5779, 339.624), abs=2e-3)


@NUM_VERTICES
def test_it_is_symmetric(num_vertices):
    vertices = BuiltinBody(num_vertices).load().vertices.double()
    mirrored = vertices * torch.tensor([-1.0, 1.0, 1.0])
    assert float(torch.cdist(vertices, mirrored).amin(1).amax()) < 1e-3  # slopes are taken over 0.1 mm to one side


@NUM_VERTICES
def test_every_part_follows_its_own_bones(num_vertices):
    template = BuiltinBody(num_vertices).load()
    assert float(template.weights.min()) >= 0
    assert int((template.weights > 0).sum(1).amax()) <= 4
    torch.testing.assert_close(template.weights.sum(1), torch.ones(len(template.vertices)))
    assert float(template.weights.amax(0).min()) > 0.25  # no joint without a hold
    strongest = [JOINTS[joint] for joint in template.weights.argmax(1).tolist()]
    for vertex, joint in zip(template.vertices.tolist(), strongest, strict=True):
        if abs(vertex[0]) > 0.25:
            assert joint.startswith("left" if vertex[0] > 0 else "right")
        if vertex[1] < 0.7:
            assert vertex[0] != 0  # legs of their own
        if vertex[1] > 1.62:
            assert joint == "head"


def test_a_person_is_as_tall_as_asked_and_stands_about_the_pelvis():
    vertices, joints = BuiltinBody(700).load().shaped(torch.zeros(10), 1.60)
    assert float(vertices[:, 1].amax() - vertices[:, 1].amin()) == pytest.approx(1.60, abs=1e-5)
    assert joints[0].tolist() == [0.0, 0.0, 0.0]
    ratio = 1.60 / BuiltinBody(700).load().height
    torch.testing.assert_close(joints[15], ratio * (rest_joints()[15] - rest_joints()[0]))


def test_influences_are_the_weights_without_their_zeros():
    template = BuiltinBody(700).load()
    joints, parts = template.influences()
    assert joints.shape == parts.shape == (len(template.vertices), 4)
    dense = torch.zeros_like(template.weights).scatter_(1, joints, parts)
    torch.testing.assert_close(dense, template.weights)
    assert bool((parts[:, :-1] >= parts[:, 1:]).all())


def test_too_few_vertices_and_weights_that_do_not_add_up_are_refused():
    with pytest.raises(ValueError, match="got 100"):
        BuiltinBody(100)
    with pytest.raises(ValueError, match=r"vertex 1 to 0\.5"):
        BodyTemplate(
            torch.zeros(2, 3),
            torch.zeros(0, 3, dtype=torch.int64),
            rest_joints(),
            torch.eye(2, 24) * torch.tensor([[1.0], [0.5]]),
        )
