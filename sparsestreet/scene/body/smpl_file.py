"""SMPL's body from the user's own licensed file; the package contains none."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from sparsestreet.files import read_npz
from sparsestreet.geometry.skeleton import NUM_JOINTS, PARENTS
from sparsestreet.pickles import read_pickled
from sparsestreet.scene.body.template import Body, BodyTemplate

_NUM_SHAPES = 10


@dataclass(frozen=True)
class SmplFile(Body):
    """SMPL_NEUTRAL as .npz or .pkl, from https://smpl.is.tue.mpg.de; no code in a .pkl is run."""

    path: str

    def load(self) -> BodyTemplate:
        """Returns the template. Raises FileNotFoundError with the remedy, ValueError if the file is no such body."""
        path = Path(self.path)
        if not path.is_file():
            raise FileNotFoundError(
                f"there is no SMPL file at {path}: download SMPL_NEUTRAL under its own license from "
                "https://smpl.is.tue.mpg.de, or take the body that comes with the program (BuiltinBody)"
            )
        try:
            return _template(_read(path))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ValueError(f"{path} is not SMPL's body ({error}): give SMPL_NEUTRAL.npz or .pkl") from error


def _read(path: Path) -> Mapping[str, Any]:
    if path.suffix != ".npz":
        return read_pickled(path)
    return read_npz(path, ("v_template", "f", "weights", "shapedirs", "J_regressor", "kintree_table"))


def _template(stored: Mapping[str, Any]) -> BodyTemplate:
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
