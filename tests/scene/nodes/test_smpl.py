import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.skeleton import JOINTS
from sparsestreet.ops.spherical_harmonics import FIRST
from sparsestreet.scene.body import BuiltinBody, surface
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.masks import TemporalMaskSettings
from sparsestreet.scene.masks.temporal import TemporalMask
from sparsestreet.scene.nodes import Smpl
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.triangulation import StreetPoints
from sparsestreet.types import Track
from tests.geometry.test_skeleton import oracle
from tests.scene.people import SHIRT, bent, data_of, smpl, smpl_settings, walker
from tests.scene.street import NUM_FRAMES, triangulated, view_at
from tests.typed import as_a, there

TEMPLATE = BuiltinBody(500).load()
VERTICES = len(TEMPLATE.vertices)
HAIR = (0.1, 0.2, 0.9)


def in_box(track: Track, frame: int, means: torch.Tensor) -> torch.Tensor:
    place = track.frames.tolist().index(frame)
    rotation, center = track.world_from_object[place, :3, :3], track.world_from_object[place, :3, 3]
    return (means.double() - center) @ rotation


def terms(node: Smpl, time: float = 0.5, drawn: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """As if all rows were drawn, unless said."""
    drawn = torch.ones(len(node.rows), dtype=torch.bool) if drawn is None else drawn
    return node.own_regularizers(node.raw_at(view_at(time), FINISHED), drawn, FINISHED)


def test_terms_are_of_rows_that_are_drawn():
    """Somebody out of view is left alone: Adam would follow the terms alone, at its full rate."""
    node = smpl(walker(), walker("other", y=2.0))
    drawn = node.rows.instances == 1
    torch.stack(list(terms(node, drawn=drawn).values())).sum().backward()
    assert not node.rows.log_scales.grad[~drawn].any()
    assert node.rows.log_scales.grad[drawn].any()
    alone = {name: term.item() for name, term in terms(smpl(walker("other", y=2.0))).items()}
    assert {name: term.item() for name, term in terms(node, drawn=drawn).items()} == pytest.approx(alone, rel=1e-4)
    nobody = terms(node, drawn=torch.zeros_like(drawn))
    assert all(term.item() == 0 for term in nobody.values())


def test_one_flat_gaussian_lies_on_each_vertex():
    node = smpl(walker(height=1.6), walker("tall", height=1.9, y=3.0))
    rows = node.rows
    assert rows.instances.tolist() == [0] * VERTICES + [1] * VERTICES
    assert rows.vertex_ids.tolist() == 2 * list(range(VERTICES))
    heights = rows.means[:, 1].view(2, VERTICES).amax(1) - rows.means[:, 1].view(2, VERTICES).amin(1)
    torch.testing.assert_close(heights, torch.tensor([1.6, 1.9]), atol=1e-5, rtol=0)
    areas, normals = surface(rows.means[:VERTICES].detach(), TEMPLATE.faces)
    axes, scales = quat.to_matrix(rows.quaternions)[:VERTICES], rows.log_scales.exp()[:VERTICES]
    torch.testing.assert_close(axes[..., 2], normals, atol=1e-4, rtol=0)
    torch.testing.assert_close(torch.pi * scales[:, 0] * scales[:, 1], areas, atol=1e-8, rtol=1e-4)
    torch.testing.assert_close(scales[:, 2], scales[:, 0] / 2)
    torch.testing.assert_close(torch.sigmoid(rows.opacity_logits), torch.full((2 * VERTICES,), 0.99))
    colors = 0.5 + FIRST * rows.sh_dc[:, 0]
    torch.testing.assert_close(colors, torch.tensor(SHIRT).expand(2 * VERTICES, 3))
    assert rows.sh_rest.shape == (2 * VERTICES, 3, 3)


def test_a_pelvis_is_as_high_as_its_own_body_says():
    people = (walker(height=1.2), walker("tall", height=1.9, y=3.0))
    both = smpl(*people)
    for instance, person in enumerate(people):
        assert both.frame_height(instance) == pytest.approx(smpl(person).frame_height(0), rel=1e-5)


def test_without_returns_a_person_is_gray():
    node = smpl_settings().build(data_of(walker(), returns=False), torch.Generator())
    torch.testing.assert_close(node.rows.sh_dc, torch.zeros(VERTICES, 1, 3))


def test_a_person_in_random_colors():
    """Uniform in [0, 1]: of 3 colors a vertex, of two people, each its own."""
    two = data_of(walker(), walker("tall", height=1.9, y=3.0))
    node = smpl_settings(random_colors=True).build(two, torch.Generator().manual_seed(0))
    colors = 0.5 + FIRST * node.rows.sh_dc[:, 0].detach()
    assert len(colors.unique()) > 0.99 * colors.numel()
    assert (colors.min() >= -1e-6, colors.max() <= 1 + 1e-6) == (True, True)
    # The standard error of the mean of n uniform numbers is 1 / sqrt(12 n).
    assert float(colors.mean()) == pytest.approx(0.5, abs=4 / (12 * colors.numel()) ** 0.5)
    assert float(colors.std()) == pytest.approx(12**-0.5, rel=0.1)


@pytest.mark.parametrize(("returns", "elsewhere"), [(True, SHIRT), (False, HAIR)])
def test_points_of_images_color_what_is_near_them(returns, elsewhere):
    """Four above the head; the returns are in the middle of the box."""
    above = triangulated([[0.0, 0.0, 0.9]] * 4, color=HAIR)
    points = StreetPoints(triangulated([]), {"walker": above})
    data = replace(data_of(walker(), returns=returns), image_points=points)
    colors = 0.5 + FIRST * smpl_settings().build(data, torch.Generator()).rows.sh_dc[:, 0]
    for vertex, color in (
        (TEMPLATE.vertices[:, 1].argmax(), HAIR),
        (TEMPLATE.vertices.norm(dim=1).argmin(), elsewhere),
    ):
        torch.testing.assert_close(colors[vertex], torch.tensor(color))


def test_a_mask_over_time_counts_places_from_each_body():
    """From -1 to 1 along each axis, of a child as of somebody tall."""
    people = (walker(height=1.2), walker("tall", height=1.9, y=3.0))
    node = smpl(*people, mask=TemporalMaskSettings(1e-4), masked=True)
    places = as_a(TemporalMask, node.mask)._places(node.rows).view(2, VERTICES, 3)
    torch.testing.assert_close(places.amax(1), torch.ones(2, 3))
    torch.testing.assert_close(places.amin(1), -torch.ones(2, 3))


def test_the_body_moves_as_4x4_matrices_say():
    track = walker()
    node = smpl(track)
    shape, joints = TEMPLATE.shaped(torch.zeros(10), 1.6)
    bodies, answers = [], []
    for frame in range(NUM_FRAMES):
        rotations = track.body.rotations[frame].double().numpy()
        matrices = np.einsum("vj,jab->vab", TEMPLATE.weights.double().numpy(), oracle(joints.numpy(), rotations))
        points = np.append(shape.numpy(), np.ones((VERTICES, 1)), 1)
        expected = torch.from_numpy(np.einsum("vab,vb->va", matrices, points)[:, :3])
        bodies.append(in_box(track, frame, expected + track.world_from_object[frame, :3, 3]))
        world = node.gaussians_at(view_at(frame / (NUM_FRAMES - 1)), FINISHED)
        answers.append(in_box(track, frame, world.means))
        # An undeformed part turns as a whole: the crown with the head.
        crown = int(TEMPLATE.vertices[:, 1].argmax())
        turn = torch.from_numpy(matrices[crown][:3, :3])
        before = quat.to_matrix(node.rows.quaternions[crown].double())
        assert float(TEMPLATE.weights[crown].amax()) > 0.9
        after = quat.to_matrix(world.quaternions[crown].double())
        torch.testing.assert_close(after, turn @ before, atol=0.05, rtol=0)
    # On average the body stands in the middle of its box.
    middle = torch.stack([(body.amax(0) + body.amin(0)) / 2 for body in bodies]).mean(0)
    torch.testing.assert_close(torch.stack(answers), torch.stack(bodies) - middle, atol=1e-5, rtol=0)


def test_joints_are_half_turned_between_keyframes():
    angles = torch.linspace(0, 2.0, NUM_FRAMES)
    node = smpl(bent(walker(), "left_elbow", angles))
    rotations = node.joint_rotations(0.5 / (NUM_FRAMES - 1))
    expected = torch.zeros(1, 24, 4)
    expected[..., 0] = 1
    expected[0, JOINTS.index("left_elbow")] = quat.from_rotation_vector(torch.tensor([0.0, 0.0, 0.25]))
    torch.testing.assert_close(rotations, expected, atol=1e-6, rtol=0)


def test_corrections_of_joints_turn_in_the_frame_of_the_joint():
    """R exp([delta]), as for boxes; scenes that are stored depend on the order."""
    node = smpl(walker())
    with torch.no_grad():
        node.joint_deltas.add_(torch.randn(node.joint_deltas.shape, generator=torch.Generator().manual_seed(2)))
    found = node.joint_rotations(1 / (NUM_FRAMES - 1))[0, 1:].detach()
    keyframes = Rotation.from_quat(node.joint_keyframes[0, 1].numpy(), scalar_first=True)
    corrected = keyframes * Rotation.from_rotvec(node.joint_deltas[0, 1].detach().numpy())
    np.testing.assert_allclose(quat.to_matrix(found).numpy(), corrected.as_matrix(), atol=1e-6)  # float32


def test_frames_without_a_pose_are_between_those_that_have_one():
    angles = torch.tensor([9.0, 0.4, 9.0, 1.2, 9.0])
    node = smpl(bent(walker(valid=(False, True, False, True, False)), "right_knee", angles))
    found = node.joint_rotations
    for frame, angle in enumerate((0.4, 0.4, 0.8, 1.2, 1.2)):
        expected = quat.from_rotation_vector(torch.tensor([0.0, 0.0, angle]))
        turned = found(frame / (NUM_FRAMES - 1))[0, JOINTS.index("right_knee")]
        torch.testing.assert_close(turned, expected, atol=1e-6, rtol=0)
    # Upright in the box, whose heading turns on.
    torch.testing.assert_close(node.pose_at(0.0).quaternions, walker().body.rotations[:1, 0], atol=1e-6, rtol=0)


def test_nothing_of_held_out_frames_is_used():
    # Frame 3 has no pose of its own: it is between 1 and 4, not between 2 and 4.
    track = walker(valid=(True, True, True, False, True))
    changed = replace(track, body=replace(there(track.body), rotations=track.body.rotations.flip(2)))
    mixed = torch.where(torch.arange(NUM_FRAMES)[:, None, None] == 2, changed.body.rotations, track.body.rotations)
    other = replace(track, body=replace(there(track.body), rotations=mixed))
    nodes = [smpl(person, held_out=frozenset({2})) for person in (track, other)]
    for (name, first), second in zip(nodes[0].state_dict().items(), nodes[1].state_dict().values(), strict=True):
        assert torch.equal(first, second), name
    assert nodes[0].keyframe_valid.sum() == NUM_FRAMES - 1
    assert not torch.equal(smpl(track).joint_keyframes, smpl(other).joint_keyframes)


def test_a_person_without_a_pose_in_a_training_frame_is_left_out(caplog):
    unseen = walker("unseen", valid=(False, False, True, False, False))
    with caplog.at_level(logging.WARNING):
        node = smpl(walker(), unseen, held_out=frozenset({2}))
    assert node.names == ("walker",)
    assert "1 people have no pose" in caplog.text
    assert smpl_settings().build(data_of(unseen, held_out=frozenset({2})), torch.Generator()) is None
    assert not smpl_settings().takes(replace(walker(), body=None))


def test_people_of_different_spans_have_their_own_keyframes():
    short = walker("short", frames=(1, 2), y=3.0, seed=5)
    node = smpl(walker(), short)
    alone = smpl(short)
    both, one = node.gaussians_at(view_at(0.375), FINISHED), alone.gaussians_at(view_at(0.375), FINISHED)
    torch.testing.assert_close(both.means[VERTICES:], one.means)
    torch.testing.assert_close(both.quaternions[VERTICES:], one.quaternions)
    late = node.gaussians_at(view_at(1.0), FINISHED)
    assert (late.opacities[:VERTICES] > 0.9).all()
    assert (late.opacities[VERTICES:] == 0).all()


def test_the_gap_is_counted_in_frames():
    """Annotated in all five frames, of which training sees the first and the last."""
    node = smpl(walker(), held_out=frozenset({1, 2, 3}), max_gap=1)
    assert [node.pose_at(frame / 4).present.item() for frame in range(5)] == [True, True, False, True, True]


def test_one_frame_is_enough():
    node = smpl(walker(frames=(2,)), min_path_length=-1.0)
    assert torch.isfinite(node.gaussians_at(view_at(0.5), FINISHED).means).all()
    assert all(torch.isfinite(value) for value in terms(node).values())


def test_removed_vertices_do_not_move_the_others():
    node = smpl(walker(), walker("other", y=3.0, seed=3))
    before = node.gaussians_at(view_at(0.4), FINISHED)
    keep = torch.rand(len(node.rows), generator=torch.Generator().manual_seed(1)) < 0.5
    node.rows.resize(RowPlan.keep(keep))
    after = node.gaussians_at(view_at(0.4), FINISHED)
    torch.testing.assert_close(after.means, before.means[keep])
    torch.testing.assert_close(after.quaternions, before.quaternions[keep])
    assert node.instances().counts().sum() == keep.sum()


def test_neighbors_are_looked_for_when_rows_have_gone_and_only_then():
    node = smpl(walker(), walker("other", y=3.0))
    first = node._nearest()
    assert node._nearest() is first
    assert torch.equal(first[:, 0], torch.arange(len(node.rows)))
    keep = torch.arange(len(node.rows)) % 3 != 0
    keep[VERTICES + 2 :] = False  # two of the second person stay
    node.rows.resize(RowPlan.keep(keep))
    found = node._nearest()
    assert found.shape == (len(node.rows), 3)
    assert (node.rows.instances[found] == node.rows.instances[:, None]).all()
    vertices = TEMPLATE.vertices[node.rows.vertex_ids[:10]]
    own = TEMPLATE.vertices[node.rows.vertex_ids[node.rows.instances == 0]]
    nearest = torch.cdist(vertices, own, compute_mode="donot_use_mm_for_euclid_dist").topk(3, largest=False).values
    distances = (TEMPLATE.vertices[node.rows.vertex_ids[found[:10]]] - vertices[:, None]).norm(dim=2)
    torch.testing.assert_close(distances, nearest)
    node.rows.resize(RowPlan.keep(torch.zeros(len(node.rows), dtype=torch.bool)))
    assert terms(node) == {}
    assert len(node.gaussians_at(view_at(0.5), FINISHED)) == 0


def test_neighbors_are_looked_for_anew_where_as_many_rows_came_as_went():
    node = smpl(walker())
    before = node._nearest()
    turned = torch.arange(VERTICES).flip(0)
    node.rows.resize(RowPlan(VERTICES, turned, torch.zeros(VERTICES, dtype=torch.bool)))
    torch.testing.assert_close(node._nearest()[:, 0], torch.arange(VERTICES))
    assert torch.equal(node.rows.vertex_ids[node._nearest()].sort(1).values.flip(0), before.sort(1).values)


def test_regularizers_by_hand():
    node = smpl(walker(), neighbor_weight=2.0, scale_weight=3.0)
    rows = node.rows
    with torch.no_grad():
        for column in (rows.log_scales, rows.quaternions, rows.opacity_logits, rows.sh_dc, rows.sh_rest):
            column += 0.3 * torch.randn(column.shape, generator=torch.Generator().manual_seed(2))
    unit = rows.quaternions / rows.quaternions.norm(dim=1, keepdim=True)
    columns = (unit, rows.log_scales.exp(), rows.opacity_logits.sigmoid(), rows.sh_dc, rows.sh_rest)
    expected = 0.0
    for column in columns:
        values = column.detach().numpy().reshape(len(rows), -1)[node._nearest().numpy()]
        expected += values.std(axis=1, ddof=1).mean()
    found = {name: value.detach() for name, value in terms(node).items()}
    assert set(found) == {"neighbors", "scale"}
    assert float(found["neighbors"]) == pytest.approx(2.0 * expected, rel=1e-5)
    longest = rows.log_scales.detach().exp().numpy().max(axis=1)
    assert float(found["scale"]) == pytest.approx(3.0 * np.mean(longest**2), rel=1e-5)
    assert terms(smpl(walker(), neighbor_weight=0.0, scale_weight=0.0)) == {}


def test_regularizers_have_finite_gradients_where_all_neighbors_are_equal():
    """The slope of a standard deviation of 0 is none."""
    node = smpl(walker(), smoothness_weight=1.0)
    torch.stack(list(terms(node).values())).sum().backward()
    for name, parameter in node.named_parameters():
        assert parameter.grad is None or torch.isfinite(parameter.grad).all(), name


def test_even_motion_is_smooth_whatever_frames_are_held_out():
    even, jerky = torch.linspace(0, 0.4, NUM_FRAMES), torch.tensor([0.0, 0.3, 0.0, 0.3, 0.0])
    smooth = smpl(bent(walker(), "neck", even), held_out=frozenset({1}), smoothness_weight=1.0)
    rough = smpl(bent(walker(), "neck", jerky), smoothness_weight=1.0)
    # A chord in place of the arc: fourth order in the angle.
    assert terms(smooth)["smoothness"].item() < 1e-6
    # All three middles are off by 0.3 rad, a quaternion by half of that, of one joint in 23.
    assert terms(rough)["smoothness"].item() == pytest.approx((2 * math.sin(0.075)) ** 2 / 23, rel=0.02)


def test_motion_is_uneven_where_there_are_three_keyframes():
    """Of five keyframes three have both neighbors, of three one: the mean over four, whatever pads the table."""
    people = (walker(), walker("short", frames=(1, 2, 3), y=3.0, seed=5))
    both, long, short = (
        terms(smpl(*some, smoothness_weight=1.0))["smoothness"].item() for some in (people, people[:1], people[1:])
    )
    assert both == pytest.approx((3 * long + short) / 4, rel=1e-5)


def test_gradients_of_corrections_are_finite_differences():
    node = smpl(walker(), held_out=frozenset({1}))
    node.rows.resize(RowPlan.keep(torch.arange(VERTICES) % 60 == 0))
    node.double()
    generator = torch.Generator().manual_seed(3)

    def placed(joints, means):
        parameters = {"joint_deltas": joints, "rows.means": means}
        raw = torch.func.functional_call(node, parameters, (view_at(0.3), FINISHED))
        return raw.means, raw.quaternions

    node.forward = node.raw_at
    joints = 0.1 * torch.randn(node.joint_deltas.shape, generator=generator, dtype=torch.float64)
    inputs = (joints.requires_grad_(), node.rows.means.detach().clone().requires_grad_())
    assert torch.autograd.gradcheck(placed, inputs, fast_mode=True)


def test_bytes_of_poses():
    node = smpl(walker(), walker("short", frames=(1, 2), y=3.0))
    keyframes, influences = NUM_FRAMES + 2, TEMPLATE.influences()[0].numel()
    numbers = keyframes * (1 + 3 + 4 * 24) + 2 * 24 * 3 + VERTICES * 3 + 2 * influences
    assert node.pose_bytes() == 4 * numbers


def test_a_checkpoint_of_fewer_rows_fits():
    small, large = smpl(walker()), smpl(walker())
    small.rows.resize(RowPlan.keep(torch.arange(VERTICES) % 2 == 0))
    with torch.no_grad():
        small.joint_deltas.add_(0.1)
    large.load_state_dict(small.state_dict())
    first, second = (node.gaussians_at(view_at(0.4), SceneState()) for node in (small, large))
    assert torch.equal(first.means, second.means)
    assert torch.equal(large._nearest(), small._nearest())


def test_what_no_node_of_people_can_be_is_refused():
    with pytest.raises(ValueError, match="has_body_pose=False"):
        smpl_settings(has_body_pose=False)
    with pytest.raises(ValueError, match="at least 2, got 1"):
        smpl_settings(neighbors=1)
