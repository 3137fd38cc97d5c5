import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.skeleton import HEIGHT, JOINTS, PARENTS, Bones, posed_bones, rest_joints, skin

BODIES, POINTS = 3, 40


def random_quaternions(generator: torch.Generator, *shape: int, angle: float) -> torch.Tensor:
    """Rotations of about ``angle`` radians."""
    return quat.from_rotation_vector(angle * torch.randn(*shape, 3, generator=generator, dtype=torch.float64))


def random_bodies(seed: int, angle: float = 0.6) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    joints = rest_joints().double() + 0.05 * torch.randn(BODIES, 24, 3, generator=generator, dtype=torch.float64)
    return joints, random_quaternions(generator, BODIES, 24, angle=angle)


def attachment(seed: int) -> tuple[torch.Tensor, ...]:
    """Points and rotations, each moved by four neighbors in the tree of one body."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(POINTS, 3, generator=generator, dtype=torch.float64)
    quaternions = random_quaternions(generator, POINTS, angle=2.0)
    joint = torch.randint(1, 24, (POINTS,), generator=generator)
    chain = [joint]
    for _ in range(3):
        chain.append(torch.tensor([max(PARENTS[int(above)], 0) for above in chain[-1]]))
    body = torch.randint(BODIES, (POINTS, 1), generator=generator)
    weights = torch.rand(POINTS, 4, generator=generator, dtype=torch.float64)
    return points, quaternions, 24 * body + torch.stack(chain, 1), weights / weights.sum(1, keepdim=True)


def all_of(bones: Bones) -> Bones:
    """Those of all bodies, one after the other."""
    return Bones(bones.transforms.flatten(0, 1), bones.quaternions.flatten(0, 1))


def oracle(joints: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """One body by the textbook: 4x4 matrices down the tree, then back to rest; [24, 4, 4]."""
    placed: list[np.ndarray] = []
    for joint, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_quat(np.roll(rotations[joint], -1)).as_matrix()
        local[:3, 3] = joints[joint] - (0 if parent < 0 else joints[parent])
        placed.append(local if parent < 0 else placed[parent] @ local)
    result = []
    for joint, matrix in enumerate(placed):
        to_joint = np.eye(4)
        to_joint[:3, 3] = -joints[joint]
        result.append(matrix @ to_joint)
    return np.stack(result)


def test_the_tree_is_smpls_and_symmetric():
    assert (len(JOINTS), len(PARENTS)) == (24, 24)
    assert all(parent < joint for joint, parent in enumerate(PARENTS))
    named = {name: None if parent < 0 else JOINTS[parent] for name, parent in zip(JOINTS, PARENTS, strict=True)}
    assert named["left_hand"] == "left_wrist"
    assert named["head"] == "neck"
    assert named["right_collar"] == "spine3"
    mirrored = {
        name.replace("left", "right"): parent and parent.replace("left", "right")
        for name, parent in named.items()
        if "left" in name
    }
    assert mirrored.items() <= named.items()
    joints = dict(zip(JOINTS, rest_joints().tolist(), strict=True))
    assert all(joints[name.replace("left", "right")][0] == -joints[name][0] < 0 for name in JOINTS if "left" in name)
    assert joints["left_ankle"][1] < joints["left_knee"][1] < joints["pelvis"][1] < joints["head"][1] < HEIGHT


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_joints_move_as_matrices_down_the_tree(dtype):
    joints, rotations = random_bodies(0, angle=1.5)
    found = posed_bones(joints.to(dtype), rotations.to(dtype))
    expected = np.stack([oracle(j, r)[:, :3] for j, r in zip(joints.numpy(), rotations.numpy(), strict=True)])
    tolerance = 1e-5 if dtype is torch.float32 else 1e-12
    np.testing.assert_allclose(found.transforms.double().numpy(), expected, atol=tolerance)
    np.testing.assert_allclose(quat.to_matrix(found.quaternions).double().numpy(), expected[..., :3], atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_points_and_rotations_are_blended(dtype):
    joints, rotations = random_bodies(1)
    points, quaternions, attached, weights = attachment(2)
    matrices = np.concatenate([oracle(j, r) for j, r in zip(joints.numpy(), rotations.numpy(), strict=True)])
    moved, turned = skin(
        points.to(dtype), quaternions.to(dtype), all_of(posed_bones(joints.to(dtype), rotations.to(dtype))), attached,
        weights.to(dtype),
    )  # fmt: skip
    for row in range(POINTS):
        parts = list(zip(attached[row].tolist(), weights[row].tolist(), strict=True))
        expected = sum(weight * matrices[bone] for bone, weight in parts) @ np.append(points[row].numpy(), 1.0)
        np.testing.assert_allclose(moved[row].double().numpy(), expected[:3], atol=1e-5)
        turns = Rotation.from_matrix(np.stack([matrices[bone][:3, :3] for bone, _ in parts])).as_quat()
        turns *= np.sign(turns @ turns[0])[:, None]
        turn = Rotation.from_quat((turns * weights[row].numpy()[:, None]).sum(0)).as_matrix()
        expected = turn @ quat.to_matrix(quaternions[row]).numpy()
        np.testing.assert_allclose(quat.to_matrix(turned[row]).double().numpy(), expected, atol=1e-5)


def test_a_blended_rotation_is_nearly_that_of_the_blended_matrix():
    """At an elbow bent by 90 degrees, for every share of the bones; the polar factor of a matrix is its rotation."""
    shares = torch.linspace(0, 1, 21, dtype=torch.float64)
    quarter = quat.from_rotation_vector(torch.tensor([[0.0, 0.0, 0.0], [0.0, np.pi / 2, 0.0]], dtype=torch.float64))
    matrices = quat.to_matrix(quarter)
    bones = Bones(torch.nn.functional.pad(matrices, (0, 1)), quarter)
    identity = quarter[:1].expand(21, 4)
    both, weights = torch.tensor([[0, 1]]).expand(21, 2), torch.stack((1 - shares, shares), 1)
    _, turned = skin(torch.zeros(21, 3, dtype=torch.float64), identity, bones, both, weights)
    left, _, right = torch.linalg.svd((weights[..., None, None] * matrices).sum(1))
    between = Rotation.from_matrix((left @ right).mT @ quat.to_matrix(turned)).magnitude()
    assert 2.0 < np.degrees(between.max()) < 3.5
    assert between[[0, 10, 20]].max() < 1e-12


def test_rest_moves_nothing_and_the_pelvis_turns_all():
    joints, rotations = random_bodies(3)
    rest = torch.zeros_like(rotations)
    rest[..., 0] = 1
    identity = torch.eye(4, dtype=torch.float64)[:3].expand(BODIES, 24, 3, 4)
    torch.testing.assert_close(posed_bones(joints, rest).transforms, identity, atol=1e-14, rtol=0)
    rest[:, 0] = rotations[:, 0]
    turned = posed_bones(joints, rest).transforms
    whole = quat.to_matrix(rotations[:, :1]).expand(BODIES, 24, 3, 3)
    torch.testing.assert_close(turned[..., :3], whole, atol=1e-14, rtol=0)
    pelvis = (turned[..., :3] @ joints[:, :1, :, None])[..., 0] + turned[..., 3]
    torch.testing.assert_close(pelvis, joints[:, :1].expand(BODIES, 24, 3), atol=1e-14, rtol=0)


def test_the_sign_of_a_rotation_changes_nothing():
    joints, rotations = random_bodies(6)
    signs = torch.where(torch.rand(BODIES, 24, 1) < 0.5, -1.0, 1.0).double()
    plain, flipped = posed_bones(joints, rotations), posed_bones(joints, signs * rotations)
    torch.testing.assert_close(plain.quaternions, flipped.quaternions, atol=1e-14, rtol=0)


def test_gradients_are_finite_differences():
    joints, rotations = random_bodies(4)
    points, quaternions, attached, weights = attachment(5)

    def moved(points, quaternions, joints, vectors):
        turned = quat.multiply(rotations, quat.from_rotation_vector(vectors))
        return skin(points, quaternions, all_of(posed_bones(joints, turned)), attached, weights)

    inputs = [points, quaternions, joints, torch.zeros(BODIES, 24, 3, dtype=torch.float64)]
    assert torch.autograd.gradcheck(moved, [tensor.clone().requires_grad_() for tensor in inputs], fast_mode=True)
