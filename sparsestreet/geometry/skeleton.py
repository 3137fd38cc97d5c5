"""The joints of a human body, how each moves the next, and how they move attached points.

Joints, their order and the frame are those of SMPL (Loper et al., SIGGRAPH Asia 2015). y points up, x to the person's
left, z forward. At rest the arms are stretched out sideways.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.geometry import quaternions as quat

JOINTS: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""Position in ``JOINTS``; the pelvis, -1, is the root."""

NUM_JOINTS = len(JOINTS)

HEIGHT = 1.75
"""Height of the body that ``rest_joints`` describes, meters."""


def rest_joints() -> Float[Tensor, "24 3"]:
    """The joints of our own body model at rest, meters: ``HEIGHT`` tall, the ground at y = 0, proportions rounded.

    >>> rest_joints()[JOINTS.index("pelvis")].tolist()
    [0.0, 0.93..., 0.0]
    """
    middle = {
        "pelvis": (0.0, 0.93, 0.0), "spine1": (0.0, 1.03, 0.0), "spine2": (0.0, 1.15, 0.0),
        "spine3": (0.0, 1.22, 0.0), "neck": (0.0, 1.44, 0.0), "head": (0.0, 1.54, 0.015),
    }  # fmt: skip
    left = {
        "hip": (0.085, 0.88, 0.0), "knee": (0.085, 0.475, 0.01), "ankle": (0.085, 0.075, 0.0),
        "foot": (0.085, 0.03, 0.12), "collar": (0.07, 1.36, 0.0), "shoulder": (0.18, 1.36, 0.0),
        "elbow": (0.45, 1.36, 0.0), "wrist": (0.71, 1.36, 0.0), "hand": (0.79, 1.36, 0.0),
    }  # fmt: skip
    places = middle | {f"left_{name}": place for name, place in left.items()}
    places |= {f"right_{name}": (-x, y, z) for name, (x, y, z) in left.items()}
    return torch.tensor([places[name] for name in JOINTS])


def _ancestors() -> tuple[tuple[int, ...], ...]:
    """Round r holds, for each joint, its ancestor 2^r generations up; NUM_JOINTS stands for no joint."""
    step = (*(NUM_JOINTS if parent < 0 else parent for parent in PARENTS), NUM_JOINTS)
    rounds = []
    while any(joint != NUM_JOINTS for joint in step):
        rounds.append(step)
        step = tuple(step[joint] for joint in step)
    return tuple(rounds)


_ANCESTORS = _ancestors()


@dataclass(frozen=True)
class Bones:
    """How joints move attached points from rest. The batch is b bodies, or the joints of several bodies in one list."""

    transforms: Float[Tensor, "*b 3 4"]
    """Rigid transforms of points at rest, meters."""
    quaternions: Float[Tensor, "*b 4"]
    """Unit rotations of the transforms; neighbors in the tree never differ by the sign alone."""


def posed_bones(joints: Float[Tensor, "b 24 3"], rotations: Float[Tensor, "b 24 4"]) -> Bones:
    """The transforms by which the joints move attached points.

    Args:
        joints: positions at rest, meters.
        rotations: unit rotations of each joint about itself, relative to its parent. The pelvis turns the whole body.

    Rotations along the tree are multiplied by doubling: after round r each joint holds the product over 2^(r + 1)
    generations. SMPL's deepest joint takes four rounds instead of eight steps.

    >>> still = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(1, NUM_JOINTS, 4)
    >>> posed_bones(rest_joints()[None], still).transforms[0, 0].tolist()
    [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    """
    turns = torch.where(rotations[..., :1] < 0, -rotations, rotations)
    nothing = torch.zeros_like(turns[:, :1])
    nothing[..., 0] = 1
    turns, steps = torch.cat((turns, nothing), 1), torch.tensor(_ANCESTORS).to(joints.device, non_blocking=True)
    for above in steps:
        turns = quat.multiply(turns[:, above], turns)
    matrices = quat.to_matrix(turns)
    # The parent's rotation moves a joint; positions add up along the tree in the same rounds.
    parents = steps[0, :-1]
    from_parent = joints - torch.nn.functional.pad(joints, (0, 0, 0, 1))[:, parents]
    moved = (matrices[:, parents] @ from_parent[..., None]).squeeze(-1)
    places = torch.nn.functional.pad(moved, (0, 0, 0, 1))
    for above in steps:
        places = places + places[:, above]
    matrices, places = matrices[:, :-1], places[:, :-1, :, None]
    transforms = torch.cat((matrices, places - matrices @ joints[..., None]), -1)
    return Bones(transforms, turns[:, :-1])


def skin(
    points: Float[Tensor, "n 3"],
    quaternions: Float[Tensor, "n 4"],
    bones: Bones,
    attached: Int[Tensor, "n k"],
    weights: Float[Tensor, "n k"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    """Linear blend skinning: returns moved points and rotations (not unit).

    Blended transforms move the points, blended quaternions turn the rotations. A blended quaternion takes
    a tenth of the time of a blended matrix. Its rotation differs by 3 degrees where two bones meet at a right angle.

    Args:
        points: positions at rest, meters.
        quaternions: rotations at the points.
        bones: rows of ``transforms`` and ``quaternions`` of all bodies, one after the other.
        attached: rows of the bones that move each point.
        weights: their weights, which sum to 1; they get no gradient.

    >>> rest = torch.tensor([1.0, 0.0, 0.0, 0.0])
    >>> up = torch.cat((torch.eye(3), torch.tensor([[0.0], [2.0], [0.0]])), 1)  # by 2 m
    >>> bones = Bones(torch.stack((torch.eye(3, 4), up)), rest.expand(2, 4))
    >>> points, _ = skin(torch.zeros(1, 3), rest[None], bones, torch.tensor([[0, 1]]), torch.tensor([[0.75, 0.25]]))
    >>> points.tolist()
    [[0.0, 0.5, 0.0]]
    """
    table = torch.cat((bones.transforms.flatten(1), bones.quaternions), 1)
    blended = torch.nn.functional.embedding_bag(attached, table, per_sample_weights=weights, mode="sum")
    transform, turn = blended[:, :12].unflatten(1, (3, 4)), blended[:, 12:]
    moved = (transform[..., :3] @ points[..., None]).squeeze(-1) + transform[..., 3]
    return moved, quat.multiply(turn, quaternions)
