"""The frozen values that the rooms of the package hand to each other.

Conventions, everywhere:

- The world frame is metric and right-handed, and re-centered when a log is read.
- The camera frame is OpenCV's: x right, y down, z forward. Pixel centers are at +0.5.
- Quaternions are wxyz. ``a_from_b`` maps points of frame b to frame a.
- Time is in [0, 1], next to the integer frame. If the log has a clock, also in seconds and integer nanoseconds.
- Images are float32 in [0, 1] at the splat op, and uint8 in storage.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Float64, Int, UInt8
from torch import Tensor

from sparsestreet.finite import check_finite, check_rows

_RIGIDITY = 1e-3
"""Largest entry of R^T R - I of a box's pose; readers are stricter (``data.poses``)."""

Side = Literal["top", "bottom", "left", "right"]
"""A side of an image."""


def _check_times(time: float, seconds: float | None) -> None:
    if not math.isfinite(time) or (seconds is not None and not math.isfinite(seconds)):
        raise ValueError(
            f"times must be finite numbers, got time {time} and seconds {seconds}: take them from the log's views, or "
            "between them"
        )


@dataclass(frozen=True)
class Harmonics:
    """Spherical harmonics as scene nodes keep them: tables whose rows follow each other, the first coefficient apart.

    >>> first, rest = torch.zeros(2, 1, 3), torch.ones(2, 3, 3)
    >>> Harmonics((first, first), (rest[:, :0], rest), terms=4).dense()[:, 1, 0]  # what is not stored is 0
    tensor([0., 0., 1., 1.])
    """

    first: tuple[Float[Tensor, "_ 1 3"], ...]
    rest: tuple[Float[Tensor, "_ _ 3"], ...]
    """What stands behind the first coefficients, 0, 3, 8 or 15 a row."""
    terms: int
    """Coefficients in use, 1, 4, 9 or 16; a table that stores fewer uses all of its own."""

    @property
    def tables(self) -> tuple[Tensor, ...]:
        """All tables, the first coefficients before the rest."""
        return *self.first, *self.rest

    def used(self, place: int) -> int:
        """Number of coefficients in use of a table's rows."""
        return min(self.terms, 1 + self.rest[place].shape[1])

    def dense(self) -> Float[Tensor, "n k 3"]:
        """All rows in one table, padded with zeros."""
        tables = []
        for place, (first, rest) in enumerate(zip(self.first, self.rest, strict=True)):
            used = self.used(place)
            tables.append(torch.cat((first, rest[:, : used - 1]), dim=1) if used > 1 else first)
        return _joined(tables)


def _joined(tables: Sequence[Float[Tensor, "_ _ 3"]]) -> Float[Tensor, "n k 3"]:
    """The rows of all tables; those with fewer coefficients are padded with zeros."""
    if len(tables) == 1:
        return tables[0]
    terms = max(table.shape[1] for table in tables)
    # pad copies even when it adds nothing, and the harmonics are most of a scene's memory traffic.
    padded = [
        table if table.shape[1] == terms else torch.nn.functional.pad(table, (0, 0, 0, terms - table.shape[1]))
        for table in tables
    ]
    return torch.cat(padded)


@dataclass(frozen=True)
class Gaussians:
    """Activated 3D Gaussians in the world frame."""

    means: Float[Tensor, "n 3"]
    """Centers, meters."""
    quaternions: Float[Tensor, "n 4"]
    """Rotation world_from_gaussian, wxyz, any non-zero length."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the Gaussian's own axes, meters, >= 0."""
    opacities: Float[Tensor, " n"]
    """Peak alpha in [0, 1]; a row with opacity 0 is culled before projection."""
    sh: Float[Tensor, "n k 3"] | Harmonics
    """Spherical harmonics, k in {1, 4, 9, 16}; color = max(0, 0.5 + sum_i basis_i(direction) sh_i)."""
    displacements: Float[Tensor, "n 3"] | None = None
    """How far each row moves while an image is read out, meters in the world; None: nothing moves.

    Used only with ``Camera.shutter``. It gets no gradient."""

    def __len__(self) -> int:
        return self.means.shape[0]

    def dense_sh(self) -> Float[Tensor, "n k 3"]:
        """Return the harmonics as one table, which is a copy where nodes keep them."""
        return self.sh.dense() if isinstance(self.sh, Harmonics) else self.sh

    def columns(self) -> dict[str, Tensor]:
        """Return the five fields that every row has, the harmonics as one table, by name."""
        named = {name: getattr(self, name) for name in ("means", "quaternions", "scales", "opacities")}
        return named | {"sh": self.dense_sh()}

    def learned(self) -> tuple[Tensor, ...]:
        """Means, quaternions, scales, opacities and the tables of harmonics: all that gets gradients."""
        tables = self.sh.tables if isinstance(self.sh, Harmonics) else (self.sh,)
        return self.means, self.quaternions, self.scales, self.opacities, *tables

    @property
    def terms(self) -> int | None:
        """Coefficients in use of the tables of harmonics; None: there is one table, of which all are."""
        return self.sh.terms if isinstance(self.sh, Harmonics) else None

    @staticmethod
    def of_learned(fields: Sequence[Tensor], terms: int | None, displacements: Tensor | None = None) -> "Gaussians":
        """Return the Gaussians of which these are ``learned()`` and ``terms``."""
        means, quaternions, scales, opacities, *tables = fields
        half = len(tables) // 2
        sh = tables[0] if terms is None else Harmonics(tuple(tables[:half]), tuple(tables[half:]), terms)
        return Gaussians(means, quaternions, scales, opacities, sh, displacements)

    @staticmethod
    def concatenate(parts: "list[Gaussians]") -> "Gaussians":
        """Joins the rows of all parts in order; parts of a lower SH degree are padded with zeros."""
        if len(parts) == 1:
            return parts[0]
        return Gaussians(
            torch.cat([part.means for part in parts]),
            torch.cat([part.quaternions for part in parts]),
            torch.cat([part.scales for part in parts]),
            torch.cat([part.opacities for part in parts]),
            _joined([part.dense_sh() for part in parts]),
            Gaussians._displacements(parts),
        )

    @staticmethod
    def _displacements(parts: "list[Gaussians]") -> Tensor | None:
        if all(part.displacements is None for part in parts):
            return None
        still = [torch.zeros_like(p.means) if p.displacements is None else p.displacements for p in parts]
        return torch.cat(still)


@dataclass(frozen=True)
class Shutter:
    """Motion of a camera while its rows or columns are read one after the other. Its pose is that at the middle one."""

    translation: Float[Tensor, "3"]
    """Displacement of the camera over the whole readout, meters, in the camera frame."""
    rotation: Float[Tensor, "3"]
    """Rotation vector of the camera over the whole readout, radians, in the camera frame."""
    direction: Side = "top"
    """The side of the image that is read first: rows from "top" or "bottom", columns from "left" or "right"."""
    seconds: float = 0.0
    """How long the readout takes; 0: not known, and objects are taken to stand still meanwhile."""
    span: float = 0.0
    """The same in the log's normalized time; 0 in a log without a clock."""

    @property
    def reads_columns(self) -> bool:
        return self.direction in ("left", "right")

    @property
    def sign(self) -> int:
        """1 if later rows or columns have larger pixel coordinates, else -1."""
        return 1 if self.direction in ("top", "left") else -1


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, with lens distortion and a rolling shutter if they are given. Its tensors are on the host."""

    camera_from_world: Float[Tensor, "4 4"]
    intrinsics: Float[Tensor, "3 3"]
    """Pixels; the top left pixel's center is at (0.5, 0.5)."""
    width: int
    height: int
    distortion: Float[Tensor, "5"] | None = None
    """Brown-Conrady k1, k2, p1, p2, k3, in OpenCV's order; None: a pinhole, which costs nothing."""
    shutter: Shutter | None = None
    """None: all pixels are exposed at once, which costs nothing."""
    exposure: float = 0.0
    """Seconds that light falls on a pixel; 0: not known."""

    @property
    def position(self) -> Float[Tensor, "3"]:
        """Camera center in the world, meters."""
        rotation, translation = self.camera_from_world[:3, :3], self.camera_from_world[:3, 3]
        return -rotation.T @ translation


@dataclass(frozen=True)
class View:
    """A camera and a time at which a scene is seen. Raises ValueError for times that are not finite."""

    camera: Camera
    time: float
    """Normalized time in [0, 1]: that of its own stamp where the log has a clock, else that of its frame."""
    frame_index: int | None = None
    """Integer frame of the log; all cameras of one instant share it. None: not a recorded frame."""
    camera_index: int | None = None
    """Number of the camera in the log's rig; None: not a camera of the rig."""
    seconds: float | None = None
    """Seconds since the first stamp of the log; None: the log has no clock."""
    stamp: int | None = None
    """Nanoseconds on the log's own clock, whose zero is arbitrary; None: no clock, or between the recorded frames."""

    def __post_init__(self) -> None:
        _check_times(self.time, self.seconds)

    @property
    def indices(self) -> tuple[int, int]:
        """Frame and camera index of a recorded view. Raises ValueError for any other."""
        if self.frame_index is None or self.camera_index is None:
            raise ValueError(
                f"a recorded view has a frame and a camera index, got {self.frame_index} and {self.camera_index}: "
                "take the views of a log"
            )
        return self.frame_index, self.camera_index


MASK_KINDS = ("sky", "human", "vehicle", "ego")
"""Fields of a frame that are masks."""

MaskSource = Literal["fine", "coarse", "given", "shipped", "true"]
"""Whose masks a log has: "fine" and "coarse" as DriveStudio's folders are called, "given" by the user, "shipped" by the
data set itself, "true" of a synthetic street. Numbers of people and vehicles compare within one source alone."""


@dataclass(frozen=True, kw_only=True)
class Frame(View):
    """A view with its image and what is known about its pixels. A recorded frame has both indices."""

    image: UInt8[Tensor, "h w 3"]
    sky: Bool[Tensor, "h w"] | None = None
    human: Bool[Tensor, "h w"] | None = None
    vehicle: Bool[Tensor, "h w"] | None = None
    depth: Float[Tensor, "h w"] | None = None
    """Lidar depth along the optical axis, meters; 0 where the pixel has no return."""
    ego: Bool[Tensor, "h w"] | None = None
    """Pixels of the recording car itself, such as its hood."""

    @classmethod
    def of(cls, view: View, **pixels: Any) -> "Frame":
        """The view, all that it says, with its pixels."""
        return cls(**{entry.name: getattr(view, entry.name) for entry in fields(View)}, **pixels)


@dataclass(frozen=True)
class Sweep:
    """Lidar points of one instant in the world frame, with colors where a camera of that instant sees them. Raises
    ValueError for times that are not finite."""

    index: int
    time: float
    """Normalized time in [0, 1] at which the points are where they are."""
    points: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    """RGB in [0, 1]; rows without ``colored`` are gray 0.5."""
    colored: Bool[Tensor, " n"]
    seconds: float | None = None
    """Since the first stamp of the log; None: the log has no clock."""
    stamp: int | None = None
    """Nanoseconds on the log's own clock; None: it has none."""
    origin: Float64[Tensor, "3"] | None = None
    """Where its lidar stood, of several the one with the most returns; world, meters. None: the log does not tell."""

    def __post_init__(self) -> None:
        _check_times(self.time, self.seconds)


@dataclass(frozen=True)
class SparsePoints:
    """Points on what stands still that came with a log: found in its images, such as COLMAP's, measured by no lidar."""

    positions: Float[Tensor, "n 3"]
    """World, meters."""
    colors: Float[Tensor, "n 3"]
    """RGB in [0, 1]; gray 0.5 where it is not known."""
    notes: tuple[str, ...] = ()
    """What of them was lost or guessed, one sentence each."""

    def __len__(self) -> int:
        return self.positions.shape[0]


@dataclass(frozen=True)
class BodyPoses:
    """Rotations of a person's 24 joints (SMPL's, in its order), one entry per annotated frame of the track.

    The body's own frame: y up, x to the person's left, z forward, at rest in T-pose.
    """

    rotations: Float[Tensor, "f 24 4"]
    """Unit quaternions, wxyz. Joint 0 is world_from_root; the others are relative to their parent."""
    valid: Bool[Tensor, " f"]
    """Whether the frame has a pose."""
    shape: Float[Tensor, "10"]
    """SMPL's betas."""


@dataclass(frozen=True)
class Track:
    """One annotated object. Its box frame has x along the length (heading), y left, z up, the origin at the center.

    Raises ValueError for a size that is not positive, for poses and times that are not finite, poses that are no rigid
    motion, and frames or times that do not increase.
    """

    name: str
    class_name: str
    frames: Int[Tensor, " f"]
    """Annotated integer frames, strictly increasing; gaps are allowed."""
    world_from_object: Float64[Tensor, "f 4 4"]
    size: Float[Tensor, "3"]
    """Length, width, height, meters (mean over the annotated frames)."""
    body: BodyPoses | None = None
    """How a person moves inside the box; None: unknown, or not a person."""
    times: Float64[Tensor, " f"] | None = None
    """Normalized times of the boxes; None: those of their frames in a log without a clock, frame / (frames - 1)."""
    span: tuple[float, float] | None = None
    """Normalized times of the first and last image or box of the annotated frames, between which it is there; None:
    from the first box to the last."""
    found: bool = False
    """Whether nobody annotated it: its boxes are those of a smooth path through its lidar returns, which may drift."""

    def __post_init__(self) -> None:
        what, poses = f"object {self.name} ({self.class_name})", self.world_from_object
        good = (self.size > 0) & torch.isfinite(self.size)
        remedy = "write length, width and height in meters, or leave the object out"
        check_rows(f"the size of {what}", self.size, good, "must be positive and finite", remedy, row="side")
        remedy = "leave that box out, or write its pose again"
        check_finite({f"a pose of {what}": poses}, remedy, row="box")
        rotations = poses[:, :3, :3]
        bent = rotations.mT @ rotations - torch.eye(3, dtype=poses.dtype, device=poses.device)
        last = poses[:, 3] - poses.new_tensor([0.0, 0.0, 0.0, 1.0])
        error = torch.maximum(bent.abs().amax((1, 2)), last.abs().amax(1))
        # Of a mirrored box R^T R is right too.
        error = torch.where(torch.linalg.det(rotations) > 0, error, error.clamp(min=2.0))
        invariant = f"must be a rotation and a translation, R^T R - I at most {_RIGIDITY:g}"
        check_rows(f"each pose of {what}", error, error <= _RIGIDITY, invariant, remedy, row="box")
        orders = {"frames": self.frames, "times": self.times}
        for name, values in ((name, values) for name, values in orders.items() if values is not None):
            later = torch.cat((torch.ones_like(values[:1], dtype=torch.bool), values.diff() > 0)) & values.isfinite()
            check_rows(f"the {name} of {what}", values, later, "must increase", "sort its boxes, one each", row="box")

    @property
    def path_length(self) -> float:
        """Length of the path of the box center over the annotated frames, meters."""
        steps = self.world_from_object[1:, :3, 3] - self.world_from_object[:-1, :3, 3]
        return float(steps.norm(dim=-1).sum())


@dataclass(frozen=True)
class Rendering:
    """What the splat op returns. Row-wise fields have one entry per input Gaussian, drawn or not."""

    rgb: Float[Tensor, "h w 3"]
    """Blended color over the background of the call; premultiplied by alpha if it had none."""
    alpha: Float[Tensor, "h w"]
    """1 - transmittance after the last splat."""
    depth: Float[Tensor, "h w"]
    """Expected depth along the optical axis, meters: sum(w z) / max(alpha, 1e-6)."""
    radii: Float[Tensor, " n"]
    """Half the longer side of the splat's pixel box, pixels; 0 for a culled row."""
    screen_offsets: Float[Tensor, "n 2"]
    """A leaf of zeros. After backward its .grad holds, per row, the sum over pixels of ``|dLoss / d mean2d|``, 1/px.

    This is the absolute gradient of AbsGS, which density control thresholds; with ``SplatSettings.plain_gradients`` it
    is the sum of dLoss / d mean2d, as in 3DGS."""

    @property
    def visible(self) -> Bool[Tensor, " n"]:
        return self.radii > 0

    @property
    def screen_gradients(self) -> Float[Tensor, "n 2"]:
        """What ``screen_offsets`` gathered. Raises ValueError where no backward pass went through them."""
        if self.screen_offsets.grad is None:
            raise ValueError("no backward pass went through screen_offsets: render with screen_gradients=True first")
        return self.screen_offsets.grad


@dataclass(frozen=True)
class Contribution:
    """What each row adds to one view (Mini-Splatting's counters, the paper's eq. for I_i)."""

    weight: Float64[Tensor, " n"]
    """Sum over pixels of the blend weight alpha * transmittance."""
    pixels: Int[Tensor, " n"]
    """Number of pixels the row was blended into."""
    dominant: Int[Tensor, " n"]
    """Number of pixels in which the row has the largest weight (ties: the nearer splat)."""


@dataclass(frozen=True)
class MedianDepth:
    """The splat behind which at most half of the light passes, in each pixel of one view."""

    depth: Float[Tensor, "h w"]
    """Of that splat's mean along the optical axis, meters; infinite where more than half passes all splats."""
    rows: Int[Tensor, "h w"]
    """Which row it is; -1 where there is none."""
    alpha: Float[Tensor, "h w"]
    """Coverage up to that splat and with it, or of all splats."""


@dataclass(frozen=True)
class LeaveOneOut:
    """How much one view changes when each row alone is removed and the others stay."""

    max_abs_change: Float64[Tensor, " n"]
    """Largest absolute change of a channel of a pixel."""
    squared_change: Float64[Tensor, "n ..."]
    """Sum over pixels and channels of the squared change times the pixel's weight, in each way that pixels weigh."""
    weight: Float64[Tensor, " n"]
    """Sum over pixels of the blend weight, as ``Contribution`` has it."""
