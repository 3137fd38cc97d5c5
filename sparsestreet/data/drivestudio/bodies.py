"""Body poses of people in humanpose/smpl.pkl: read, and written."""

import copyreg
import io
import pickle
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor
from torch._utils import _rebuild_tensor_v2

from sparsestreet.data.drivestudio.contents import world_from_camera
from sparsestreet.data.drivestudio.layout import Layout
from sparsestreet.data.poses import RIGIDITY_TOLERANCE
from sparsestreet.data.problems import LogError, Problem, fault
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.skeleton import NUM_JOINTS
from sparsestreet.pickles import read_pickled
from sparsestreet.types import BodyPoses, Track

_MASKS = ("matched_mask", "must_appear_mask", "valid_mask")
_REMEDY = "write it as DriveStudio's human pose processing does, or say data.log.bodies=false"


def with_bodies(tracks: Sequence[Track], layout: Layout) -> tuple[list[Track], tuple[str, ...]]:
    """The tracks with the body poses of the folder, frames in its own numbers, and a note on what was left out.

    A frame counts that has a box, a pose marked as valid and a camera that it was seen by; an object without such a
    frame in the window has no body. Raises LogError with every object at fault.
    """
    if not layout.has_bodies:
        return list(tracks), ()
    try:
        stored = read_pickled(layout.bodies)
        people = {str(key): person for key, person in stored.items()}
    except (AttributeError, ValueError) as error:
        raise fault(layout.bodies, f"the file cannot be read ({error})", _REMEDY) from error
    found, problems, boxless = [], [], 0
    for track in tracks:
        person = people.get(track.name)
        try:
            valid, body = (None, None) if person is None else _body(track, person, layout)
        except LogError as error:
            problems.extend(error.problems)
            continue
        if valid is not None:
            boxless += len(set(valid) - set(track.frames.tolist()))
        found.append(replace(track, body=body))
    problems += _unknown(set(people) - {track.name for track in tracks}, layout)
    if problems:
        raise LogError(problems)
    note = f"{boxless} body poses are of frames in which the person has no box: they are left out"
    return found, (note,) if boxless else ()


def _unknown(names: set[str], layout: Layout) -> list[Problem]:
    if not names:
        return []
    message = f"it has body poses of objects {sorted(names)[:5]} that {layout.instances.name} does not describe"
    return [Problem(layout.bodies, message, "write both files from the same annotations")]


def _body(track: Track, person: Any, layout: Layout) -> tuple[list[int], BodyPoses | None]:
    """The frames of the window with a valid pose, whether they have a box or not, and the poses of those that have."""
    name = f"the body of object {track.name}"
    try:
        smpl, cameras = person["smpl"], np.asarray(person["selected_cam_idx"]).astype(np.int64)
        valid = np.asarray(person["valid_mask"]).astype(bool) & (cameras >= 0)
        joints = np.concatenate((smpl["global_orient"], smpl["body_pose"]), 1).astype(np.float64)
        shapes = np.asarray(smpl["betas"], dtype=np.float32)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise fault(layout.bodies, f"{name} cannot be read ({error!r})", _REMEDY) from error
    count = layout.num_frames_on_disk
    wanted = {"selected_cam_idx": (count,), "rotations": (count, NUM_JOINTS, 3, 3), "betas": (count, 10)}
    shaped = {"selected_cam_idx": cameras.shape, "rotations": joints.shape, "betas": shapes.shape}
    if shaped != wanted or valid.shape != (count,):
        raise fault(layout.bodies, f"{name} has the shapes {shaped}, a log of {count} frames needs {wanted}", _REMEDY)
    frames = [frame for frame in layout.frames if valid[frame]]
    boxes = track.frames.tolist()
    used = [frame for frame in frames if frame in boxes]
    if not used:
        return frames, None
    rotations = torch.zeros(len(boxes), NUM_JOINTS, 3, 3, dtype=torch.float64)
    rotations[:] = torch.eye(3, dtype=torch.float64)
    for frame in used:
        rotations[boxes.index(frame)] = _in_world(joints[frame], layout, frame, int(cameras[frame]), name)
    has_pose = torch.tensor([frame in used for frame in boxes])
    return frames, BodyPoses(quat.from_matrix(rotations).float(), has_pose, torch.from_numpy(shapes[used[0]].copy()))


def _in_world(joints: np.ndarray, layout: Layout, frame: int, camera: int, name: str) -> Float64[Tensor, "24 3 3"]:
    """The root, which is stored as the camera sees it, turned to the world."""
    rotations = torch.from_numpy(joints.copy())
    error = (rotations.mT @ rotations - torch.eye(3, dtype=torch.float64)).abs().amax()
    # Estimated rotations are float32 of a network's output: a few times what poses of cameras show.
    if not bool(error < 10 * RIGIDITY_TOLERANCE) or bool((torch.linalg.det(rotations) < 0).any()):
        message = (
            f"{name} at frame {frame} has joints that are no rotations: R^T R or det R is off by {float(error):.2g}"
        )
        raise fault(layout.bodies, message, _REMEDY)
    rotations[0] = world_from_camera(layout, frame, camera)[:3, :3] @ rotations[0]
    return rotations


def blank_person(num_frames: int) -> dict[str, Any]:
    """A person of the file in a log of so many frames, without a pose in any."""
    rotations = np.tile(np.eye(3, dtype=np.float32), (num_frames, NUM_JOINTS, 1, 1))
    masks = {mask: np.zeros(num_frames, bool) for mask in _MASKS}
    smpl = {
        "global_orient": rotations[:, :1].copy(),
        "body_pose": rotations[:, 1:].copy(),
        "betas": np.zeros((num_frames, 10), np.float32),
    }
    return {"smpl": smpl, "selected_cam_idx": np.full(num_frames, -1, np.int64), **masks}


def set_pose(person: dict[str, Any], frame: int, joints: np.ndarray, camera: int) -> None:
    """Give a person a pose in a frame: 24 x 3 x 3 rotations of the joints, that of the root as the camera sees it."""
    person["smpl"]["global_orient"][frame] = joints[:1]
    person["smpl"]["body_pose"][frame] = joints[1:]
    person["selected_cam_idx"][frame] = camera
    for mask in _MASKS:
        person[mask][frame] = True


def pickled_people(people: dict[int, dict[str, Any]]) -> bytes:
    """The file of people by their ids, of tensors, as DriveStudio's loaders need them; equal for equal people.

    PyTorch's own pickles of tensors differ from call to call, and NumPy's arrays need the reader's NumPy to be as new.
    """
    file = io.BytesIO()
    pickler = pickle.Pickler(file, protocol=4)
    pickler.dispatch_table = {**copyreg.dispatch_table, np.ndarray: _as_tensor}
    pickler.dump(people)
    return file.getvalue()


def _as_tensor(array: np.ndarray) -> tuple[Any, ...]:
    """How ``torch.load`` of any version makes the tensor with an array's numbers."""
    kept, tensor = io.BytesIO(), torch.from_numpy(array).clone()
    torch.save(tensor._typed_storage(), kept)
    storage = _Storage(kept.getvalue())
    arguments = (storage, 0, tuple(tensor.shape), tensor.stride(), False, OrderedDict())
    return _rebuild_tensor_v2, arguments


@dataclass(frozen=True)
class _Storage:
    """The numbers of a tensor, which are pickled as PyTorch pickles them."""

    content: bytes

    def __reduce__(self) -> tuple[Any, ...]:
        return torch.storage._load_from_bytes, (self.content,)
