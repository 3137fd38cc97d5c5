"""Clouds of a scene: where, when and what they are, beside what the scene itself says."""

from dataclasses import replace

import numpy as np
import torch

from sparsestreet.export.frame import dome_around
from sparsestreet.export.path import recorded
from sparsestreet.export.recording import Cloud, Part, recorded_parts
from sparsestreet.geometry import quaternions as quat
from sparsestreet.ops import splat
from sparsestreet.scene.edits import REMOVED, Change, Edits, Moved, edited
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Background, Smpl
from sparsestreet.types import Gaussians
from tests.export.street import NUM_FRAMES, stored_street, street_views
from tests.scene.people import smpl, walker
from tests.typed import as_a

PATH = recorded(street_views(cameras=(0, 1)))
FIRST_HARMONIC = 0.28209479177


def parts_of(stored, every: int = 1) -> dict[str, Part]:
    return {part.name: part for part in recorded_parts(stored, PATH, every)}


def in_world(cloud: Cloud, position: np.ndarray, wxyz: np.ndarray) -> Gaussians:
    """Gaussians of the same covariances, by their eigenvectors; float64 until the end."""
    turn = quat.to_matrix(torch.from_numpy(wxyz).double())
    variances, axes = torch.linalg.eigh(torch.from_numpy(cloud.covariances).double())
    axes[:, :, 0] *= torch.linalg.det(axes)[:, None]
    means = torch.from_numpy(cloud.centers).double() @ turn.T + torch.from_numpy(position).double()
    sh = (torch.from_numpy(cloud.colors) - 0.5)[:, None] / FIRST_HARMONIC
    scales = variances.clamp(min=0).sqrt().float()
    return Gaussians(
        means.float(), quat.from_matrix(turn @ axes).float(), scales, torch.from_numpy(cloud.opacities), sh
    )


def drawn(parts: dict[str, Part], instant: int) -> Gaussians:
    found = []
    for part in parts.values():
        shape = part.shown[instant]
        if shape is not None:
            found.append(in_world(part.shapes[shape], part.positions[instant], part.wxyz[instant]))
    return Gaussians.concatenate(found)


def flat_street():
    """The street without sky and view dependence, which clouds do not have."""
    stored = stored_street()
    with torch.no_grad():
        for node in stored.scene.nodes.values():
            node.rows.sh_rest.zero_()
    return replace(stored, scene=stored.scene.without("sky"))


def test_clouds_at_their_poses_are_the_scene():
    stored = flat_street()
    parts = parts_of(stored)
    assert {name: len(part.shapes) for name, part in parts.items()} == {
        "background": 1, "rigid/car": 1, "rigid/tram": 1,
    }  # fmt: skip
    assert parts["rigid/tram"].shown == (0, 0, 0, None, None)
    for instant in (0, 3):
        view = PATH[instant][0]
        image = splat(drawn(parts, instant), view.camera, settings=stored.options.settings).rgb
        # Colors are clamped to [0, 1], which the scene's are not; the rest is rounding.
        clamped = stored.render(view).rgb.clamp(0, 1)
        assert float((image - clamped).abs().mean()) < 0.02
        assert float((image - clamped).abs().median()) < 1e-3


def test_a_cloud_has_the_color_that_the_cameras_see_on_average_those_nearer_more():
    stored = stored_street()
    background = as_a(Background, stored.scene.nodes["background"])
    with torch.no_grad():
        background.rows.means[:] = torch.tensor([8.0, 0.0, 1.0])
        background.rows.sh_dc.zero_()
        background.rows.sh_rest.zero_()
        # The third term of degree 1 is -sqrt(3 / 4 pi) x.
        background.rows.sh_rest[:, 2] = 0.5
    (cloud,) = parts_of(stored)["background"].shapes
    total = weight = 0.0
    for rig in PATH:
        camera = rig[0].camera  # that to the left sees nothing ahead
        toward = torch.tensor([8.0, 0.0, 1.0]).double() - camera.position.double()
        depth = float(toward @ camera.camera_from_world[2, :3].double())
        unit = toward / toward.norm()
        total += (0.5 - 0.5 * (3 / (4 * np.pi)) ** 0.5 * float(unit[0])) / depth**2
        weight += 1 / depth**2
    np.testing.assert_allclose(cloud.colors, total / weight, atol=1e-5)


def test_clouds_of_a_scene_with_antialias_are_fainter_where_cameras_see_less_of_their_light():
    stored = stored_street()
    mip = replace(stored, options=replace(stored.options, settings=replace(stored.options.settings, antialias=True)))
    trained, plain = parts_of(stored), parts_of(mip)
    for name, part in plain.items():
        for shape, other in zip(part.shapes, trained[name].shapes, strict=True):
            assert (shape.opacities <= other.opacities).all()
            assert (shape.opacities < 0.999 * other.opacities).any()


def test_edits_are_honored():
    stored = stored_street()
    before = parts_of(stored)
    scene = edited(stored.scene, Edits({"tram": REMOVED, "car": Change(Moved(up=2.0))}))
    after = parts_of(replace(stored, scene=scene))
    assert set(after) == {"background", "rigid/car"}
    moved = after["rigid/car"].positions - before["rigid/car"].positions
    np.testing.assert_allclose(moved, np.tile([0, 0, 2.0], (NUM_FRAMES, 1)), atol=1e-6)


def test_a_walker_has_a_shape_every_so_many_instants():
    people = smpl(walker("anna", tuple(range(NUM_FRAMES))))
    stored = replace(stored_street(), scene=SceneGraph({"people": people}))
    part = parts_of(stored, every=2)["people/anna"]
    assert len(part.shapes) == 3
    assert part.shown == (0, 0, 1, 1, 2)
    assert not np.allclose(part.shapes[0].centers, part.shapes[1].centers, atol=1e-3)
    # In the middle of those that show it: at the second, the fourth and the last instant.
    node = as_a(Smpl, people)
    for shape, instant in ((0, 1), (1, 3), (2, 4)):
        with torch.no_grad():
            found = stored.scene.gaussians_at(PATH[instant][0]).gaussians.means.numpy()
        world = in_world(part.shapes[shape], part.positions[instant], part.wxyz[instant]).means.numpy()
        assert len(world) == len(node.rows)
        np.testing.assert_allclose(world, found, atol=1e-5)


def test_what_is_never_drawn_is_left_out():
    stored = stored_street()
    background = as_a(Background, stored.scene.nodes["background"])
    with torch.no_grad():
        background.rows.opacity_logits[:10] = -8.0  # an alpha of 0.0003, below 1/255
    (cloud,) = parts_of(stored)["background"].shapes
    assert len(cloud) == len(background.rows) - 10


def test_the_dome_has_the_skys_color_in_every_direction():
    stored = stored_street()
    parts = tuple(parts_of(stored).values())
    dome = dome_around(stored.scene, parts)
    assert dome is not None
    radii = np.linalg.norm(dome.centers, axis=1)
    np.testing.assert_allclose(radii, radii[0], rtol=1e-5)
    assert radii[0] > max(float(np.abs(shape.centers).max()) for part in parts for shape in part.shapes)
    for view in (PATH[0][0], PATH[4][1]):
        here = in_world(dome, view.camera.position.numpy(), np.array([1.0, 0, 0, 0], np.float32))
        shown = splat(here, view.camera, settings=stored.options.settings)
        alone = replace(
            stored, scene=stored.scene.with_nodes({"none": stored.scene.without("rigid").nodes["background"]})
        )
        with torch.no_grad():
            alone.scene.nodes["none"].rows.opacity_logits[:] = -20.0
        sky = alone.render(view).rgb
        assert float(shown.alpha.min()) > 0.9
        # A disc covers those behind it by up to their distance, 2 degrees; texels of 22 degrees differ by 0.33.
        assert float((shown.rgb - sky).abs().mean()) < 0.33 * 2 / 22
    assert dome_around(stored.scene.without("sky"), parts) is None
