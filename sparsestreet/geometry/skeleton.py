"""The joints of a human body, how they move each other, and how they move what is attached to them.

Joints, their order and the frame are those of SMPL (Loper et al., SIGGRAPH Asia 2015): y up, x to the person's left,
z forward, arms stretched out sideways at rest.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.geometry import quaternions as quat

JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""Position in ``JOINTS``; the pelvis, -1, is the root."""

NUM_JOINTS = len(JOINTS)

HEIGHT = 1.75
"""Of the body that ``rest_joints`` describes, meters."""


def rest_joints() -> Float[Tensor, "24 3"]:
    """A body of our own, ``HEIGHT`` tall, at rest: meters, on the ground at y = 0. The proportions are rounded."""
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
    """Round r: of each joint the one 2^r generations up; NUM_JOINTS stands for nothing, also for itself."""
    step = (*(NUM_JOINTS if parent < 0 else parent for parent in PARENTS), NUM_JOINTS)
    rounds = []
    while any(joint != NUM_JOINTS for joint in step):
        rounds.append(step)
        step = tuple(step[joint] for joint in step)
    return tuple(rounds)


_ANCESTORS = _ancestors()


@dataclass(frozen=True)
class Bones:
    """How joints have moved from rest what is attached to them: b bodies, or rows of several bodies in one."""

    transforms: Float[Tensor, "*b 3 4"]
    """Rigid, of points at rest, meters."""
    quaternions: Float[Tensor, "*b 4"]
    """Rotations of the transforms, unit; neighbors in the tree never differ by the sign alone."""


def posed_bones(joints: Float[Tensor, "b 24 3"], rotations: Float[Tensor, "b 24 4"]) -> Bones:
    """Where the joints take what is attached to them.

    Args:
        joints: at rest, meters.
        rotations: unit, of each joint relative to its parent, about the joint; the pelvis's, about itself, turns the
            body.

    Rotations along the tree are multiplied by doubling: after round r each joint holds those of 2^(r + 1)
    generations, so the deepest of SMPL's takes four rounds instead of eight steps.
    """
    turns = torch.where(rotations[..., :1] < 0, -rotations, rotations)
    nothing = torch.zeros_like(turns[:, :1])
    nothing[..., 0] = 1
    turns, steps = torch.cat((turns, nothing), 1), torch.tensor(_ANCESTORS, device=joints.device)
    for above in steps:
        turns = quat.multiply(turns[:, above], turns)
    matrices = quat.to_matrix(turns)
    # A joint is moved by its parent's rotation; places add up along the tree as the rotations were multiplied.
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
    """Linear blend skinning: points by the blended transforms, rotations by the blended quaternions (not unit).

    A blended quaternion is the rotation of the blended matrix but for 3 degrees where two bones at a right angle meet,
    and costs a tenth of it.

    Args:
        points: at rest, meters.
        quaternions: rotations of what is at the points.
        bones: rows of ``transforms`` and ``quaternions``, of all bodies one after the other.
        attached: the bones that move a point.
        weights: their parts in it, which sum to 1; they get no gradient.
    """
    table = torch.cat((bones.transforms.flatten(1), bones.quaternions), 1)
    blended = torch.nn.functional.embedding_bag(attached, table, per_sample_weights=weights, mode="sum")
    transform, turn = blended[:, :12].unflatten(1, (3, 4)), blended[:, 12:]
    moved = (transform[..., :3] @ points[..., None]).squeeze(-1) + transform[..., 3]
    return moved, quat.multiply(turn, quaternions)
