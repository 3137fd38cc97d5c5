"""A body with a skeleton: the built-in template, SMPL from a file, and the bodies of people of a log."""

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor

from sparsestreet.files import read_npz
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.capsules import Capsules
from sparsestreet.geometry.skeleton import NUM_JOINTS, PARENTS, Bones, posed_bones, rest_joints, skin
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.pickles import read_pickled
from sparsestreet.types import BodyPoses, Track


@dataclass(frozen=True)
class BodyTemplate:
    """A closed surface on the joints of ``geometry.skeleton``, in their frame: y up, x to the left, meters.

    Raises ValueError if the weights of a vertex do not sum to 1, or if only one of the two directions is given.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "t 3"]
    """Triangles, counterclockwise from outside."""
    joints: Float[Tensor, "24 3"]
    weights: Float[Tensor, "v 24"]
    """Weight of each joint for each vertex, >= 0."""
    shape_directions: Float[Tensor, "v 3 10"] | None = None
    """Displacement of the vertices per coefficient of a person's shape; None: bodies differ in height only."""
    joint_directions: Float[Tensor, "24 3 10"] | None = None
    """Displacement of the joints per coefficient."""

    def __post_init__(self) -> None:
        sums = self.weights.sum(1)
        if not bool(((sums - 1).abs() < 1e-4).all()):
            row = int((sums - 1).abs().argmax())
            raise ValueError(f"the weights of a vertex sum to 1, those of vertex {row} to {float(sums[row]):.4g}")
        if (self.shape_directions is None) != (self.joint_directions is None):
            raise ValueError("shape_directions and joint_directions come together: give both or neither")

    @property
    def height(self) -> float:
        """Height from the soles to the crown, meters."""
        return float(self.vertices[:, 1].amax() - self.vertices[:, 1].amin())

    def shaped(self, shape: Float[Tensor, "10"], height: float) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "24 3"]]:
        """Return vertices and joints of one person, with the pelvis at the origin.

        A template with directions uses the coefficients of ``shape``; any other is scaled to ``height``.
        """
        if self.shape_directions is None or self.joint_directions is None:
            scale = height / self.height
            vertices, joints = scale * self.vertices, scale * self.joints
        else:
            vertices = self.vertices + self.shape_directions @ shape
            joints = self.joints + self.joint_directions @ shape
        return vertices - joints[0], joints - joints[0]

    def influences(self) -> tuple[Int[Tensor, "v k"], Float[Tensor, "v k"]]:
        """Return the joints that move each vertex, strongest first, and their weights; k is the most of any vertex."""
        most = int((self.weights > 0).sum(1).amax())
        parts, joints = self.weights.sort(dim=1, descending=True, stable=True)
        return joints[:, :most].contiguous(), parts[:, :most].contiguous()


class Body(ABC):
    """The source of a template, as a frozen dataclass that a scene file holds as settings."""

    @abstractmethod
    def load(self) -> BodyTemplate:
        """Return the template. Raises OSError or ValueError for a file that cannot be read."""


def surface(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "t 3"]
) -> tuple[Float[Tensor, " v"], Float[Tensor, "v 3"]]:
    """Return a third of the area of the triangles around each vertex, square meters, and its outward unit normal."""
    a, b, c = vertices[faces].unbind(1)
    # Its length is twice the area, so larger triangles count more for the normal.
    across = torch.linalg.cross(b - a, c - a)
    shares = across.norm(dim=1, keepdim=True) / 6
    per_corner = torch.cat((shares, across), 1).repeat_interleave(3, 0)
    at_vertices = torch.zeros(len(vertices), 4, dtype=vertices.dtype).index_add_(0, faces.flatten(), per_corner)
    return at_vertices[:, 0], torch.nn.functional.normalize(at_vertices[:, 1:], dim=1)


Field = Callable[[Float64[np.ndarray, "n 3"]], Float64[np.ndarray, " n"]]

_STEP = 1e-4
"""Step of the finite differences of the field, meters."""


def surface_net(
    field: Field, low: tuple[float, float, float], high: tuple[float, float, float], spacing: float
) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "t 3"]]:
    """Return vertices on the zeros of a signed distance, and triangles, counterclockwise from the positive side.

    Surface nets (Gibson, MICCAI 1998) put one vertex in each grid cell that the surface passes through. The four cells
    around each edge that it crosses make a quadrilateral. The field must be positive on the faces of the box.

    >>> ball = lambda points: np.linalg.norm(points, axis=1) - 1.0
    >>> vertices, faces = surface_net(ball, (-1.5, -1.5, -1.5), (1.5, 1.5, 1.5), spacing=0.5)
    >>> bool(np.abs(ball(vertices)).max() < 1e-3), len(faces) == 2 * len(vertices) - 4
    (True, True)
    """
    lows, highs = np.array(low), np.array(high)
    # Odd, so that nodes lie in the middle plane: then a symmetric body has a symmetric mesh and a gap between its legs.
    counts = 2 * np.ceil((highs - lows) / (2 * spacing)).astype(int) + 1
    start = (lows + highs) / 2 - spacing * (counts - 1) / 2
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1)
    values = field((start + spacing * nodes).reshape(-1, 3)).reshape(tuple(counts))
    edges, cells, outwards = _crossings(values)
    number, quads = np.unique(cells, return_inverse=True)
    quads = quads.reshape(cells.shape)
    # A vertex starts at the mean of the crossings around its cell and is then moved to the surface.
    sums = np.zeros((len(number), 4))
    np.add.at(sums, quads, np.append(edges, np.ones((len(edges), 1)), 1)[:, None])
    vertices = start + spacing * sums[:, :3] / sums[:, 3:]
    for _ in range(3):
        vertices = _projected(field, vertices)
    quads = np.where(outwards[:, None], quads, quads[:, ::-1])
    return vertices, np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))


def _crossings(
    values: Float64[np.ndarray, "x y z"],
) -> tuple[Float64[np.ndarray, "e 3"], Int64[np.ndarray, "e 4"], np.ndarray]:
    """Return points of sign changes along edges, in units of the grid; the four cells around; whether values grow."""
    strides = np.array([values.shape[1] * values.shape[2], values.shape[2], 1])
    places, cells, grows = [], [], []
    for axis in range(3):
        behind, ahead = np.delete(values, -1, axis), np.delete(values, 0, axis)
        lower = np.argwhere((behind < 0) != (ahead < 0))
        before, after = behind[tuple(lower.T)], ahead[tuple(lower.T)]
        place = lower.astype(float)
        place[:, axis] += before / (before - after)
        second, third = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
        # In right-handed order around the axis; each cell is named after its lowest corner.
        around = np.array([-second - third, -third, 0, -second])
        places.append(place)
        cells.append((lower @ strides)[:, None] + around)
        grows.append(before < 0)
    return np.concatenate(places), np.concatenate(cells), np.concatenate(grows)


def _projected(field: Field, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return the points after one step of Newton's method along the gradient."""
    value = field(points)
    slope = np.stack([(field(points + step) - value) / _STEP for step in _STEP * np.eye(3)], 1)
    return points - value[:, None] * slope / (slope * slope).sum(1, keepdims=True)


_BOX = ((-0.96, -0.1, -0.25), (0.96, 1.85, 0.25))
"""Corners of a box around the body, meters, with room for a cell of the coarsest grid."""
_CELLS_TIMES_AREA = 2.5
"""Number of cells that the surface passes through, times the area of a cell's face, square meters."""


@dataclass(frozen=True)
class BuiltinBody(Body):
    """A body with about ``num_vertices`` vertices. Raises ValueError if they are too few for arms and legs.

    >>> BuiltinBody().load().joints.shape
    torch.Size([24, 3])
    """

    num_vertices: int = 700

    def __post_init__(self) -> None:
        if not 500 <= self.num_vertices <= 100_000:
            raise ValueError(f"a body has arms and legs from 500 to 100000 vertices on, got {self.num_vertices}")

    def load(self) -> BodyTemplate:
        return _built_in_template(self.num_vertices)


@functools.cache
def _built_in_template(num_vertices: int) -> BodyTemplate:
    capsules = Capsules.of_body()
    spacing = (_CELLS_TIMES_AREA / num_vertices) ** 0.5
    vertices, faces = surface_net(capsules.distances, *_BOX, spacing)
    weights = torch.from_numpy(capsules.weights(vertices)).float()
    return BodyTemplate(torch.from_numpy(vertices).float(), torch.from_numpy(faces), rest_joints(), weights)


_NUM_SHAPES = 10


@dataclass(frozen=True)
class SmplFile(Body):
    """SMPL_NEUTRAL as .npz or .pkl, from https://smpl.is.tue.mpg.de; no code in a .pkl is run."""

    path: str

    def load(self) -> BodyTemplate:
        """Return the template. Raises FileNotFoundError with the remedy, ValueError if the file is no such body."""
        path = Path(self.path)
        if not path.is_file():
            raise FileNotFoundError(
                f"there is no SMPL file at {path}: download SMPL_NEUTRAL under its own license from "
                "https://smpl.is.tue.mpg.de, or take the body that comes with the program (BuiltinBody)"
            )
        try:
            return _template_of(_read(path))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ValueError(f"{path} is not SMPL's body ({error}): give SMPL_NEUTRAL.npz or .pkl") from error


def _read(path: Path) -> Mapping[str, Any]:
    if path.suffix != ".npz":
        return read_pickled(path)
    return read_npz(path, ("v_template", "f", "weights", "shapedirs", "J_regressor", "kintree_table"))


def _template_of(stored: Mapping[str, Any]) -> BodyTemplate:
    parents = np.asarray(stored["kintree_table"])[0].astype(np.uint32).astype(np.int64)
    if tuple(parents[1:]) != PARENTS[1:]:
        raise ValueError(f"its joints are connected in another way, with parents {parents.tolist()}")
    vertices = _numbers(stored, "v_template", (-1, 3))
    regressor = _numbers(stored, "J_regressor", (NUM_JOINTS, len(vertices)))
    # Current files have 300 coefficients; people are estimated with the first ten.
    directions = _numbers(stored, "shapedirs", (len(vertices), 3, -1))[..., :_NUM_SHAPES]
    joint_directions = np.einsum("jv,vcs->jcs", regressor, directions)
    return BodyTemplate(
        torch.from_numpy(vertices).float(),
        torch.from_numpy(np.asarray(stored["f"]).astype(np.int64)),
        torch.from_numpy(regressor @ vertices).float(),
        torch.from_numpy(_numbers(stored, "weights", (len(vertices), NUM_JOINTS))).float(),
        torch.from_numpy(np.ascontiguousarray(directions)).float(),
        torch.from_numpy(joint_directions).float(),
    )


def _numbers(stored: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
    values = np.asarray(stored[name], dtype=np.float64)
    fits = len(values.shape) == len(shape) and all(
        wanted in (-1, found) for wanted, found in zip(shape, values.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"its {name} has the shape {values.shape}, not {shape}")
    return values


_MIN_STEP = 1e-9
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
    """Return shapes and poses at frames that are not held out; missing poses are interpolated in the box.

    The pelvis stays at one place in a person's box, so that the posed bodies are centered in the box on average.
    (DriveStudio centers each frame's body, so a body rocks to and fro as its limbs reach out.) Every track needs a
    valid pose in a training frame.
    """
    shaped = [template.shaped(_body(track).shape, float(track.size[2])) for track in tracks]
    vertices, joints = (torch.stack(parts) for parts in zip(*shaped, strict=True))
    attached, weights = template.influences()
    still = torch.zeros(vertices.shape[1], 4)
    roots, rotations, places = [], [], []
    for i, track in enumerate(tracks):
        in_box = _filled(track, held_out)
        bones = posed_bones(joints[i].expand(len(in_box), 24, 3), in_box)
        each = (Bones(*parts) for parts in zip(bones.transforms, bones.quaternions, strict=True))
        # Vertices relative to the pelvis, along the axes of the annotated box.
        bodies = torch.stack([skin(vertices[i], still, one, attached, weights)[0] for one in each])
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
    """Return whether each annotated frame has a pose that training may see."""
    trained = torch.tensor([int(frame) not in held_out for frame in track.frames])
    return trained & _body(track).valid


def _body(track: Track) -> BodyPoses:
    if track.body is None:
        raise ValueError(
            f"track {track.name!r} has no body poses: give it to a node for objects without (has_body_pose: false)"
        )
    return track.body


def _filled(track: Track, held_out: frozenset[int]) -> Float[Tensor, "f 24 4"]:
    """Return joints at all annotated frames, the first one box_from_body, by slerp between the frames with a pose.

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
    step = (known[upper] - known[lower]).clamp(min=1 if track.times is None else _MIN_STEP)
    fraction = ((times - known[lower]) / step).clamp(0, 1).float()
    return quat.slerp(rotations[lower], rotations[upper], fraction[:, None].expand(-1, 24))


@dataclass(frozen=True)
class Anatomy:
    """The data that move v vertices of i people, with k keyframes each."""

    vertices: Float[Tensor, "v 3"]
    """Vertices of the template at rest, which define neighbors."""
    attached: Int[Tensor, "v m"]
    """Joints that move each vertex."""
    weights: Float[Tensor, "v m"]
    joints: Float[Tensor, "i 24 3"]
    """Joints at rest, relative to the pelvis, meters."""
    joint_keyframes: Float[Tensor, "i k 23 4"]
    """Rotations of all joints but the pelvis, relative to their parents."""

    @staticmethod
    def of(template: BodyTemplate, people: People) -> "Anatomy":
        return Anatomy(template.vertices, *template.influences(), people.joints, people.rotations)
