"""The people of a log on a body template: their shapes, and their poses at training frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.skeleton import Bones, posed_bones, skin
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.scene.body.template import BodyTemplate
from sparsestreet.types import BodyPoses, Track

_LEAST_STEP = 1e-9
"""Of normalized time, far below that from one frame to the next."""


@dataclass(frozen=True)
class People:
    """Shapes and poses of i people."""

    vertices: Float[Tensor, "i v 3"]
    """Vertices at rest, relative to the pelvis, meters."""
    joints: Float[Tensor, "i 24 3"]
    """Joints at rest, meters; the pelvis is at the origin."""
    keyframes: Trajectories
    """Poses world from body, at the pelvis."""
    rotations: Float[Tensor, "i k 23 4"]
    """Rotations of all joints but the pelvis at the keyframes, relative to their parents."""
    places: Float[Tensor, "i v 3"]
    """Mean positions of the vertices in the box over the frames, meters; measured points lie near them."""


def people_of(tracks: Sequence[Track], template: BodyTemplate, held_out: frozenset[int], num_frames: int) -> People:
    """Returns shapes and poses at frames that are not held out; missing poses are interpolated in the box.

    The pelvis stays at one place in a person's box, so that the posed bodies are centered in the box on average.
    (DriveStudio centers each frame's body, so a body rocks to and fro as its limbs reach out.) Every track needs a
    valid pose in a training frame.
    """
    shaped = [template.shaped(_body(track).shape, float(track.size[2])) for track in tracks]
    vertices, joints = (torch.stack(parts) for parts in zip(*shaped, strict=True))
    attached, weights = template.influences()
    roots, rotations, places = [], [], []
    for i, track in enumerate(tracks):
        in_box = _filled(track, held_out)
        bones = posed_bones(joints[i].expand(len(in_box), 24, 3), in_box)
        bodies = torch.stack([_posed(vertices[i], bones, frame, attached, weights) for frame in range(len(in_box))])
        middle = ((bodies.amax(1) + bodies.amin(1)) / 2).mean(0)
        places.append(bodies.mean(0) - middle)
        box_from_body = torch.eye(4, dtype=torch.float64).repeat(len(in_box), 1, 1)
        box_from_body[:, :3, :3] = quat.to_matrix(in_box[:, 0].double())
        box_from_body[:, :3, 3] = -middle.double()
        roots.append(replace(track, world_from_object=track.world_from_object @ box_from_body))
        trained = torch.tensor([int(frame) not in held_out for frame in track.frames])
        rotations.append(in_box[trained, 1:])
    keyframes = Trajectories.from_tracks(roots, held_out, num_frames)
    padded = torch.zeros(*keyframes.valid.shape, 23, 4)
    padded[..., 0] = 1
    padded[keyframes.valid] = torch.cat(rotations)
    return People(vertices, joints, keyframes, padded, torch.stack(places))


def trained_poses(track: Track, held_out: frozenset[int]) -> Bool[Tensor, " f"]:
    """Returns whether each annotated frame has a pose that training may see."""
    trained = torch.tensor([int(frame) not in held_out for frame in track.frames])
    return trained & _body(track).valid


def _body(track: Track) -> BodyPoses:
    if track.body is None:
        raise ValueError(
            f"track {track.name!r} has no body poses: give it to a node for objects without (has_body_pose: false)"
        )
    return track.body


def _filled(track: Track, held_out: frozenset[int]) -> Float[Tensor, "f 24 4"]:
    """Returns joints at all annotated frames, the first one box_from_body, by slerp between the frames with a pose.

    Poses are relative to the box, so a person without a pose turns with the box.
    """
    body, usable = _body(track), trained_poses(track, held_out)
    times = track.frames if track.times is None else track.times
    world_from_box = quat.from_matrix(track.world_from_object[:, :3, :3]).to(body.rotations.dtype)
    rotations = body.rotations.clone()
    rotations[:, 0] = quat.multiply(world_from_box * torch.tensor([1.0, -1.0, -1.0, -1.0]), rotations[:, 0])
    known, rotations = times[usable], rotations[usable]
    upper = torch.searchsorted(known, times).clamp(max=len(known) - 1)
    lower = (torch.searchsorted(known, times, right=True) - 1).clamp(min=0)
    step = (known[upper] - known[lower]).clamp(min=1 if track.times is None else _LEAST_STEP)
    fraction = ((times - known[lower]) / step).clamp(0, 1).float()
    return quat.slerp(rotations[lower], rotations[upper], fraction[:, None].expand(-1, 24))


def _posed(
    vertices: Float[Tensor, "v 3"],
    bones: Bones,
    frame: int,
    attached: Int[Tensor, "v k"],
    weights: Float[Tensor, "v k"],
) -> Float[Tensor, "v 3"]:
    """Returns the body's vertices relative to its pelvis, along the axes of its annotated box."""
    still = torch.zeros(len(vertices), 4)
    return skin(vertices, still, Bones(bones.transforms[frame], bones.quaternions[frame]), attached, weights)[0]
