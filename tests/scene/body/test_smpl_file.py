"""Files laid out as SMPL's, with numbers of our own."""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import torch

from sparsestreet.geometry.skeleton import PARENTS
from sparsestreet.scene.body import SmplFile

VERTICES = 30


def contents() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    weights, regressor = rng.random((VERTICES, 24)), rng.random((24, VERTICES))
    parents = np.array([2**32 - 1, *PARENTS[1:]], dtype=np.uint32)
    return {
        "v_template": rng.standard_normal((VERTICES, 3)),
        "f": rng.integers(VERTICES, size=(7, 3)).astype(np.uint32),
        "weights": weights / weights.sum(1, keepdims=True),
        "shapedirs": rng.standard_normal((VERTICES, 3, 300)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "kintree_table": np.stack((parents, np.arange(24, dtype=np.uint32))),
    }


def write(path: Path, stored: dict) -> SmplFile:
    if path.suffix == ".npz":
        np.savez(path, **stored)
    else:
        sparse = stored | {"J_regressor": scipy.sparse.csc_matrix(stored["J_regressor"])}
        path.write_bytes(pickle.dumps(sparse, 2))
    return SmplFile(str(path))


FORMATS = pytest.mark.parametrize("name", ["SMPL_NEUTRAL.npz", "SMPL_NEUTRAL.pkl"])


@FORMATS
def test_a_person_has_the_shape_of_the_coefficients(name, tmp_path):
    stored = contents()
    template = write(tmp_path / name, stored).load()
    shape = torch.linspace(-2, 2, 10)
    vertices, joints = template.shaped(shape, height=1.0)
    expected = stored["v_template"] + np.einsum("vcs,s->vc", stored["shapedirs"][..., :10], shape.numpy())
    expected_joints = stored["J_regressor"] @ expected
    # float32 of a few meters.
    np.testing.assert_allclose(vertices.numpy(), expected - expected_joints[0], atol=2e-5)
    np.testing.assert_allclose(joints.numpy(), expected_joints - expected_joints[0], atol=2e-5)
    np.testing.assert_array_equal(template.faces.numpy(), stored["f"])
    np.testing.assert_allclose(template.weights.numpy(), stored["weights"], atol=1e-7)
    numbers = [value for value in vars(template).values() if value.is_floating_point()]
    assert [value.dtype for value in numbers] == [torch.float32] * 5


@FORMATS
def test_other_bodies_are_refused(name, tmp_path):
    stored = contents()
    with pytest.raises(ValueError, match=r"its weights has the shape \(30, 52\), not \(30, 24\)"):
        write(tmp_path / name, stored | {"weights": np.zeros((VERTICES, 52))}).load()
    other = stored["kintree_table"].copy()
    other[0, 5] = 1
    with pytest.raises(ValueError, match="connected in another way"):
        write(tmp_path / name, stored | {"kintree_table": other}).load()


def test_a_hostile_file_does_not_run(tmp_path):
    class Hostile:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'it_ran'}",)

    (tmp_path / "SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(contents() | {"extra": Hostile()}, 2))
    with pytest.raises(ValueError, match=r"asks for posix\.system"):
        SmplFile(str(tmp_path / "SMPL_NEUTRAL.pkl")).load()
    np.savez(tmp_path / "SMPL_NEUTRAL.npz", **contents() | {"f": np.array([Hostile()])})  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="allow_pickle=False"):
        SmplFile(str(tmp_path / "SMPL_NEUTRAL.npz")).load()
    assert not (tmp_path / "it_ran").exists()


def test_a_missing_file_comes_with_the_remedy(tmp_path):
    with pytest.raises(FileNotFoundError, match="download SMPL_NEUTRAL"):
        SmplFile(str(tmp_path / "nothing.npz")).load()
