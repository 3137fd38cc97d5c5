import math

import pytest
import torch

from sparsestreet.geometry import quaternions as quat
from sparsestreet.ops.activate import activate
from sparsestreet.scene.nodes import Rigid
from tests.scene.street import degree, keyframes, pose, random_rows, rigid, track, view_at
from tests.typed import there

FRAMES = 11
"""Frame f is at time f / 10."""


def rigid_of(tracks, rows_per_instance=3, dtype=torch.float64, held_out=frozenset(), max_gap=0.2, seed=0) -> Rigid:
    instances = torch.arange(len(tracks)).repeat_interleave(rows_per_instance)
    rows = random_rows(len(instances), seed, instances=instances, dtype=dtype)
    return rigid(rows, keyframes(tracks, FRAMES, held_out, dtype), max_gap=max_gap)


def covariances(gaussians) -> torch.Tensor:
    axes = quat.to_matrix(gaussians.quaternions) * gaussians.scales[:, None, :]
    return axes @ axes.mT


def test_means_and_covariances_follow_general_poses():
    generator = torch.Generator().manual_seed(3)
    matrices = []
    for _ in range(4):
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] = quat.to_matrix(torch.randn(4, generator=generator, dtype=torch.float64))
        matrix[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)
        matrices.append(matrix)
    node = rigid_of([track(str(i), [4], [matrix]) for i, matrix in enumerate(matrices)])
    view, state = view_at(0.4), degree(1)
    local = activate([node.stored(view)], sh_degree=state.sh_degree)
    world = node.gaussians_at(view, state)
    for row, instance in enumerate(node.rows.instances.tolist()):
        rotation, translation = matrices[instance][:3, :3], matrices[instance][:3, 3]
        # Trajectories are float32: 1e-6 of values of a few meters.
        torch.testing.assert_close(world.means[row], rotation @ local.means[row] + translation, atol=1e-5, rtol=0)
        expected = rotation @ covariances(local)[row] @ rotation.T
        torch.testing.assert_close(covariances(world)[row], expected, atol=1e-5, rtol=0)


def test_each_instance_is_between_its_own_keyframes():
    moving = track("car", [2, 4], [pose(0.2, (0.0, 0.0, 0.0)), pose(0.6, (4.0, 2.0, 0.0))])
    late = track("late", [3, 4, 5], [pose(0.0, (0.0, y, 0.0)) for y in (0.0, 8.0, 9.0)])
    quaternions, translations, active = vars(rigid_of([moving, late]).pose_at(0.35)).values()
    expected = quat.from_matrix(pose(0.5, (0, 0, 0))[:3, :3])
    torch.testing.assert_close(quaternions[0], expected, atol=1e-6, rtol=0)  # float32 keyframes
    places = torch.tensor([[3.0, 1.5, 0.0], [0.0, 4.0, 0.0]]).double()
    torch.testing.assert_close(translations, places, atol=1e-5, rtol=0)
    assert active.tolist() == [True, True]


def test_yaw_across_180_degrees_takes_the_short_way():
    """from_matrix keeps w >= 0, so the quaternions of 170 and 190 degrees are nearly opposite in sign."""
    first, last = pose(math.radians(170), (0, 0, 0)), pose(math.radians(190), (0, 0, 0))
    assert (quat.from_matrix(first[:3, :3]) * quat.from_matrix(last[:3, :3])).sum() < 0
    quaternions, _, _ = vars(rigid_of([track("car", [0, 2], [first, last])]).pose_at(0.1)).values()
    expected = pose(math.pi, (0, 0, 0))[:3, :3]
    torch.testing.assert_close(quat.to_matrix(quaternions[0]), expected, atol=1e-6, rtol=0)


def test_absent_outside_the_annotated_span():
    node = rigid_of([track("car", [3, 4], [pose(0, (0, 0, 0))] * 2), track("tram", [0, 10], [pose(0, (1, 1, 1))] * 2)])
    # The tram's gap of 10 frames: present only within 0.2 of its two keyframes.
    presence = {0.0: (0, 1), 0.2: (0, 1), 0.3: (1, 0), 0.35: (1, 0), 0.4: (1, 0), 0.5: (0, 0), 0.8: (0, 1), 1.0: (0, 1)}
    for time, (car, tram) in presence.items():
        assert node.pose_at(time).present.tolist() == [bool(car), bool(tram)], time
        opacities = node.gaussians_at(view_at(time), degree(1)).opacities
        assert ((opacities > 0) == torch.tensor([car] * 3 + [tram] * 3, dtype=torch.bool)).all()
        assert torch.isfinite(node.gaussians_at(view_at(time), degree(1)).means).all()
    assert node.gaussians_at(view_at(0.6), degree(1)).opacities.tolist() == [0.0] * 6


def test_a_track_of_one_frame():
    node = rigid_of([track("car", [5], [pose(1.0, (3.0, 0.0, 0.0))])])
    assert node.pose_at(0.5).present.item()
    torch.testing.assert_close(node.pose_at(0.5).translations[0], torch.tensor([3.0, 0.0, 0.0]).double())
    assert not node.pose_at(0.4).present.item()
    assert not node.pose_at(0.6).present.item()


def test_every_frame_time_of_an_odd_log_is_a_knot():
    """60 frames: 1/59 has no exact float, so presence at the ends of a span needs the tolerance."""
    tracks = [track("car", list(range(7, 53)), [pose(0.01 * f, (float(f), 0.0, 0.0)) for f in range(7, 53)])]
    rows = random_rows(1, 0, instances=torch.zeros(1, dtype=torch.int64))
    node = rigid(rows, keyframes(tracks, 60), max_gap=0.0)
    for frame in range(60):
        _, translations, active = vars(node.pose_at(frame / 59)).values()
        assert active.item() == (7 <= frame < 53)
        if active.item():
            assert abs(translations[0, 0].item() - frame) < 1e-4  # float32 keyframes and times, 1 m a frame


def test_held_out_annotations_are_not_used_but_count_as_present():
    poses = [pose(0.1 * f, (float(f), 0.0, 0.0)) for f in range(2, 7)]
    poses[2] = pose(3.0, (99.0, 99.0, 99.0))  # frame 4: a lie that only a held-out annotation tells
    node = rigid_of([track("car", list(range(2, 7)), poses)], held_out=frozenset({4, 6}))
    quaternions, translations, active = vars(node.pose_at(0.4)).values()
    assert active.item()
    torch.testing.assert_close(translations[0], torch.tensor([4.0, 0.0, 0.0]).double(), atol=1e-5, rtol=0)
    expected = pose(0.4, (0, 0, 0))[:3, :3]
    torch.testing.assert_close(quat.to_matrix(quaternions[0]), expected, atol=1e-6, rtol=0)
    # Frame 6 is the last annotated one, held out: constant velocity from frames 3 and 5; after it the car is gone.
    quaternions, translations, active = vars(node.pose_at(0.6)).values()
    assert active.item()
    torch.testing.assert_close(translations[0], torch.tensor([6.0, 0.0, 0.0]).double(), atol=1e-5, rtol=0)
    # 0.1 rad beyond the keyframes by a normalized lerp: third order in the step of 0.2 rad.
    torch.testing.assert_close(quat.to_matrix(quaternions[0]), pose(0.6, (0, 0, 0))[:3, :3], atol=2e-4, rtol=0)
    assert not node.pose_at(0.7).present.item()
    # Far outside the extrapolation stops at the end of the span instead of running away.
    torch.testing.assert_close(node.pose_at(1.0).translations[0, 0].item(), 6.0, atol=1e-5, rtol=0)


def test_a_track_seen_only_in_held_out_frames_is_an_error():
    with pytest.raises(ValueError, match="'car' is annotated only in held-out frames"):
        keyframes([track("car", [4], [pose(0, (0, 0, 0))])], FRAMES, frozenset({4}))


def test_corrections_turn_in_the_box_frame_and_shift_in_metres():
    node = rigid_of([track("car", [0], [pose(0.3, (5.0, 0.0, 0.0))])])
    with torch.no_grad():
        node.rotation_deltas[0, 0] = torch.tensor([0.0, 0.0, 0.1])
        node.translation_deltas[0, 0] = torch.tensor([0.0, 0.25, 0.0])
    quaternions, translations, _ = vars(node.pose_at(0.0)).values()
    torch.testing.assert_close(quat.to_matrix(quaternions[0]), pose(0.4, (0, 0, 0))[:3, :3], atol=1e-6, rtol=0)
    torch.testing.assert_close(translations[0], torch.tensor([5.0, 0.25, 0.0]).double(), atol=1e-6, rtol=0)
    with torch.no_grad():  # about the box's own length axis, whatever its heading
        node.rotation_deltas[0, 0] = torch.tensor([0.2, 0.0, 0.0])
    length_axis = quat.to_matrix(node.pose_at(0.0).quaternions[0])[:, 0]
    torch.testing.assert_close(length_axis, pose(0.3, (0, 0, 0))[:3, 0], atol=1e-6, rtol=0)


def test_gradients_reach_rows_and_corrections():
    tracks = [
        track("car", [0, 2, 4], [pose(0.3 * i, (float(i), 0.5, 0.0)) for i in range(3)]),
        track("tram", [1, 3], [pose(3.0, (1.0, 0.0, 0.0)), pose(-3.0, (2.0, 0.0, 1.0))]),
    ]
    node = rigid_of(tracks, rows_per_instance=1)
    generator = torch.Generator().manual_seed(5)
    for delta in (node.rotation_deltas, node.translation_deltas):
        with torch.no_grad():
            delta.copy_(0.1 * torch.randn(delta.shape, generator=generator, dtype=delta.dtype))
    names = ["means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest"]
    leaves = [getattr(node.rows, name) for name in names] + [node.rotation_deltas, node.translation_deltas]

    def outputs(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        state = dict(
            zip([f"rows.{name}" for name in names] + ["rotation_deltas", "translation_deltas"], values, strict=True)
        )
        gaussians = torch.func.functional_call(node, state, (view_at(0.15), degree(1)))
        return tuple(gaussians.columns().values())

    node.forward = node.gaussians_at  # functional_call goes through the module's call
    assert torch.autograd.gradcheck(outputs, leaves)


def test_gradients_are_zero_not_nan_at_the_start():
    """Zero corrections, equal neighbors: the places where norms and arc cosines have no derivative."""
    node = rigid_of([track("car", [0, 1], [pose(0.5, (1.0, 0.0, 0.0))] * 2)], dtype=torch.float32)
    gaussians = node.gaussians_at(view_at(0.05), degree(1))
    cotangent = torch.randn(gaussians.quaternions.shape, generator=torch.Generator().manual_seed(0))
    (gaussians.quaternions * cotangent).sum().backward()
    assert torch.isfinite(there(node.rotation_deltas.grad)).all()
    assert (node.rotation_deltas.grad != 0).any()


def test_a_node_without_rows_and_one_without_instances():
    rows = random_rows(0, 0, instances=torch.zeros(0, dtype=torch.int64))
    node = rigid(rows, keyframes([track("car", [0], [pose(0, (0, 0, 0))])], FRAMES))
    assert len(node.gaussians_at(view_at(0.0), degree(3))) == 0
    node = rigid(rows, keyframes([], FRAMES))
    assert len(node.gaussians_at(view_at(0.0), degree(3))) == 0


def test_instances_that_do_not_exist_are_an_error():
    rows = random_rows(2, 0, instances=torch.tensor([0, 1]))
    with pytest.raises(ValueError, match="rows name instances 0 to 1, but there are 1"):
        rigid(rows, keyframes([track("car", [0], [pose(0, (0, 0, 0))])], FRAMES))


def test_poses_stay_float32_under_autocast():
    node = rigid_of([track("car", [0], [pose(0.3, (123.4, 0.0, 0.0))])], dtype=torch.float32)
    expected = node.gaussians_at(view_at(0.0), degree(1)).means
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(node.gaussians_at(view_at(0.0), degree(1)).means, expected)
