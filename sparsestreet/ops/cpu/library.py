"""Finding and loading the C++ library, and its plain C interface (src/interface.h)."""

import ctypes
import importlib.metadata
import itertools
import os
from ctypes import c_double, c_int32, c_int64, c_void_p
from functools import cache
from pathlib import Path

import torch  # before the library, which then shares torch's OpenMP runtime and its threads
from torch import Tensor

LIBRARY_NAME = "libsparsestreet_splat.so"
LIBRARY_VARIABLE = "SPARSESTREET_SPLAT_LIBRARY"
"""Environment variable that names another build of the library, to measure and test it."""
_INTERFACE_VERSION = 19
_LOADED_IN = os.getpid()

STATUS_OK, STATUS_BAD_VALUE, STATUS_TOO_MANY_PAIRS, STATUS_OUT_OF_MEMORY = range(4)
STAGES = ("project", "bin", "blend", "blend_backward", "project_backward", "count")


class CView(ctypes.Structure):
    """A camera and the settings of one rendering."""

    _fields_ = (
        ("rotation", c_double * 9),
        ("position", c_double * 3),
        *((name, c_double) for name in ("fx", "fy", "cx", "cy")),
        *((name, c_double) for name in ("alpha_min", "alpha_max", "transmittance_min", "eps2d", "near_plane")),
        ("max_sigma", c_double),
        ("distortion", c_double * 5),
        ("fold", c_double),
        ("shutter_translation", c_double * 3),
        ("shutter_rotation", c_double * 3),
        *((name, c_int64) for name in ("width", "height")),
        *((name, c_int64) for name in ("exclusive_stop", "antialias", "half_colors")),
        *((name, c_int64) for name in ("clamp_colors", "detach_directions", "plain_gradients", "depth_bits")),
        *((name, c_int64) for name in ("has_lens", "has_shutter", "shutter_columns", "shutter_sign")),
        *((name, c_int64) for name in ("every_tile", "pair_limit", "threads")),
    )


class CHarmonics(ctypes.Structure):
    """Pointers to the coefficients of rows that follow each other, and to their gradients."""

    _fields_ = (
        *((name, c_int64) for name in ("rows", "terms", "stored_rest", "first_stride", "rest_stride")),
        *((name, c_void_p) for name in ("first", "rest", "v_first", "v_rest")),
    )


class CRows(ctypes.Structure):
    """Pointers to the Gaussians' fields."""

    _fields_ = (
        ("count", c_int64),
        ("tables", c_int64),
        ("harmonics", ctypes.POINTER(CHarmonics)),
        *((name, c_void_p) for name in ("means", "quaternions", "scales", "opacities", "displacements", "gates")),
    )


class CSky(ctypes.Structure):
    """A cube map behind an image and the camera that sees it."""

    _fields_ = (
        ("rays", c_double * 9),
        ("transmittance_min", c_double),
        *((name, c_int64) for name in ("width", "height", "side", "threads")),
        *((name, c_void_p) for name in ("bordered", "texels", "directions")),
    )


class CRawRows(ctypes.Structure):
    """Pointers to rows as a node stores them; multipliers and instances may be null."""

    _fields_ = (
        ("count", c_int64),
        ("logit_limit", c_double),
        *((name, c_void_p) for name in ("means", "log_scales", "quaternions", "opacity_logits")),
        *((name, c_void_p) for name in ("multipliers", "instances")),
        ("num_instances", c_int64),
        *((name, c_void_p) for name in ("pose_quaternions", "pose_translations", "present")),
        ("threads", c_int64),
    )


class CKeyframes(ctypes.Structure):
    """Pointers to the tables of trajectories and of their corrections, and the time."""

    _fields_ = (
        *((name, c_int64) for name in ("instances", "length")),
        *((name, c_void_p) for name in ("times", "quaternions", "translations", "valid", "spans")),
        *((name, c_void_p) for name in ("rotation_deltas", "translation_deltas")),
        *((name, c_double) for name in ("time", "max_gap", "tolerance")),
    )


class CAdamRows(ctypes.Structure):
    """A parameter by rows, its gradient and moments, the numbers of a step, and where refused rows are counted."""

    _fields_ = (
        *((name, c_int64) for name in ("rows", "width")),
        *((name, c_void_p) for name in ("parameter", "gradient", "exp_avg", "exp_avg_sq")),
        *((name, c_double) for name in ("share", "beta", "square_share", "root", "eps", "size")),
        ("refused", c_void_p),
    )


class CScreenView(ctypes.Structure):
    """What a view shows of each row, and the size of its image."""

    _fields_ = (
        ("rows", c_int64),
        *((name, c_void_p) for name in ("gradient", "radii")),
        *((name, c_double) for name in ("half_width", "half_height", "longer")),
        *((name, c_int64) for name in ("visits_all", "threads")),
    )


class CPixelTerm(ctypes.Structure):
    """A loss that is a mean over pixels."""

    _fields_ = (
        *((name, c_int64) for name in ("kind", "pixels")),
        ("numbers", c_double * 3),
        ("weight", c_double),
        ("threads", c_int64),
    )


class CColors(ctypes.Structure):
    """An image and a recorded one of 8 bits, and what their errors are multiplied by."""

    _fields_ = (
        *((name, c_void_p) for name in ("image", "recorded")),
        *((name, c_int64) for name in ("numbers", "white")),
        ("scale", c_double),
        ("threads", c_int64),
    )


class CImagePair(ctypes.Structure):
    """Pointers to two images, and the definition of their structural similarity."""

    _fields_ = (
        *((name, c_void_p) for name in ("image", "truth")),
        *((name, c_int64) for name in ("height", "width")),
        ("taps", c_double * 11),
        *((name, c_double) for name in ("c1", "c2")),
        ("threads", c_int64),
    )


class CReport(ctypes.Structure):
    """Number of (splat, tile) pairs and the rows with most of them."""

    _fields_ = (("pairs", c_int64), ("worst_rows", c_int64 * 3), ("worst_pairs", c_int64 * 3))


def pointer(tensor: Tensor | None) -> int | None:
    """Return the address of a tensor's numbers; None, which is null in C, if it is missing."""
    return None if tensor is None else tensor.data_ptr()


def pointers(*tensors: Tensor | None) -> ctypes.Array[c_void_p]:
    """Return the addresses of tensors as an array, which C sees as one of its structs of pointers alone.

    Their order is that of src/interface.h. Layers, counters, changes and all gradients are such structs."""
    return (c_void_p * len(tensors))(*map(pointer, tensors))


def remedy() -> str:
    """How to build the library."""
    return (
        "install a C++17 compiler with OpenMP and reinstall the package from its checkout (pip install -e .); "
        "the build log names 'sparsestreet_splat' when it was built"
    )


@cache
def find_library() -> Path | None:
    """Return the path of the library, or None if it was not built.

    It is the path in LIBRARY_VARIABLE, else next to this module, else where an editable install put it. Raises
    RuntimeError if the variable names no file."""
    named = os.environ.get(LIBRARY_VARIABLE)
    if named is not None:
        if not Path(named).is_file():
            raise RuntimeError(f"{LIBRARY_VARIABLE} names no file: {named!r}; name a built library or unset it")
        return Path(named)
    beside = Path(__file__).parent / LIBRARY_NAME
    if beside.is_file():
        return beside
    try:
        files = importlib.metadata.files("sparsestreet") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        if file.name == LIBRARY_NAME and Path(file.locate()).is_file():
            return Path(file.locate())
    return None


@cache
def load_library() -> ctypes.CDLL:
    """Load the library; raise RuntimeError with the remedy if it is absent or was built from other sources."""
    path = find_library()
    if path is None:
        raise RuntimeError(f"the splat library is not built: {remedy()}")
    library = ctypes.CDLL(str(path))
    library.splat_interface_version.restype = c_int32
    version = library.splat_interface_version()
    if version != _INTERFACE_VERSION:
        raise RuntimeError(f"{path} has interface {version}, this package needs {_INTERFACE_VERSION}: {remedy()}")
    _declare(library)
    return library


def tile_size() -> int:
    """Side of the square tiles for which the loaded library was built, pixels."""
    return load_library().splat_tile_size()


def thread_count() -> int:
    """Number of threads a call may use: torch's, but one in a forked child.

    There the OpenMP runtime would wait for threads that only its parent has."""
    return torch.get_num_threads() if os.getpid() == _LOADED_IN else 1


def _declare(library: ctypes.CDLL) -> None:
    signatures = {
        "splat_tile_size": (c_int32, ()),
        "splat_variant_name": (ctypes.c_char_p, (c_int32,)),
        "splat_create": (c_void_p, (c_int32, c_int32)),
        "splat_destroy": (None, (c_void_p,)),
        "splat_poison": (None, (c_void_p,)),
        "splat_stage_seconds": (ctypes.POINTER(c_double), (c_void_p,)),
        "splat_pair_count": (c_int64, (c_void_p,)),
        "splat_sample_count": (c_int64, (c_void_p,)),
        "splat_forward": (c_int32, (c_void_p,) * 6),
        "splat_backward": (c_int32, (c_void_p,) * 6),
        "splat_finishers": (None, (c_void_p,) * 4),
        "splat_contribution": (c_int32, (c_void_p,) * 5),
        "splat_leave_one_out": (c_int32, (c_void_p,) * 6),
        "splat_gather": (c_int32, (c_void_p, c_void_p, c_int64, c_void_p, c_void_p, c_void_p)),
        "splat_over_sky": (None, (c_int32, c_int32, *(c_void_p,) * 4)),
        "splat_over_sky_backward": (None, (c_int32, c_int32, *(c_void_p,) * 5)),
        "splat_activate": (c_int32, (c_int32, c_int32, c_void_p, c_void_p)),
        "splat_activate_backward": (c_int32, (c_int32, c_int32, c_void_p, c_void_p, c_void_p)),
        "splat_poses": (None, (c_int32, c_int32, c_void_p, c_void_p)),
        "splat_poses_backward": (None, (c_int32, c_int32, c_int64, *(c_void_p,) * 5)),
        "splat_adam": (None, (c_int32, c_int32, c_void_p, c_int64, c_int64)),
        "splat_statistics": (None, (c_int32, c_int32, c_void_p, c_void_p)),
        "splat_pixel_mean": (c_int32, (c_int32, c_int32, *(c_void_p,) * 6)),
        "splat_colors": (c_int32, (c_int32, c_int32, *(c_void_p,) * 4)),
        "splat_colors_backward": (None, (c_int32, c_int32, *(c_void_p,) * 4)),
        "splat_ssim": (c_int32, (c_int32, c_int32, *(c_void_p,) * 3)),
        "splat_ssim_backward": (None, (c_int32, c_int32, *(c_void_p,) * 4)),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments


FASTEST_VARIANT = -1
_KEPT_IDLE = 2
_idle: dict[tuple[torch.dtype, int], list["Workspace"]] = {}
_uses = itertools.count()


class Workspace:
    """A handle to the library's buffers for one dtype and one instruction-set variant.

    Raises MemoryError if it cannot be made (or the variant does not run on this machine).
    """

    def __init__(self, dtype: torch.dtype, variant: int) -> None:
        self._library = load_library()
        self.key = (dtype, variant)
        self.last_use = 0
        self.handle = self._library.splat_create(int(dtype == torch.float64), variant)
        if not self.handle:
            raise MemoryError(
                f"no splat workspace for {dtype} and variant {variant}: out of memory, or no such variant"
            )

    def stage_seconds(self) -> dict[str, float]:
        """Wall time of each stage that ran last in this workspace."""
        seconds = self._library.splat_stage_seconds(self.handle)
        return {name: seconds[index] for index, name in enumerate(STAGES)}

    def pair_count(self) -> int:
        """(splat, tile) pairs of the last forward pass."""
        return self._library.splat_pair_count(self.handle)

    def sample_count(self) -> int:
        """(splat, pixel) samples that the last forward pass evaluated."""
        return self._library.splat_sample_count(self.handle)

    def poison(self) -> None:
        """Fill all buffers with NaN (tests: nothing may be read before it is written)."""
        self._library.splat_poison(self.handle)

    def __del__(self) -> None:
        if getattr(self, "handle", None):
            self._library.splat_destroy(self.handle)
            self.handle = None


class Lease:
    """A workspace on loan. It becomes idle again when the last reference to the lease is gone."""

    def __init__(self, dtype: torch.dtype, variant: int) -> None:
        idle = _idle.setdefault((dtype, variant), [])
        try:
            self.workspace = idle.pop()
        except IndexError:
            self.workspace = Workspace(dtype, variant)

    def __del__(self) -> None:
        workspace = getattr(self, "workspace", None)
        # If both are garbage of one cycle (an error's traceback), the workspace may be collected first.
        if workspace is None or not workspace.handle:
            return
        workspace.last_use = next(_uses)
        idle = _idle[workspace.key]
        if len(idle) < _KEPT_IDLE:
            idle.append(workspace)


def idle_workspaces() -> list[Workspace]:
    """Workspaces that wait for the next rendering, the most recently used one last."""
    waiting = [workspace for same_key in _idle.values() for workspace in same_key]
    return sorted(waiting, key=lambda workspace: workspace.last_use)
