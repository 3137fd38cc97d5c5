"""Files from outside are read within limits."""

import zipfile

import numpy as np
import pytest
import yaml

from sparsestreet.files import MAX_YAML, read_npz, read_yaml


def test_a_yaml_that_is_too_long_is_refused(tmp_path):
    path = tmp_path / "long.yaml"
    path.write_text("#" + "x" * MAX_YAML)
    with pytest.raises(ValueError, match="2,000,001 bytes, more than the 2,000,000 that are read"):
        read_yaml(path, yaml.safe_load)


def test_bytes_behind_an_array_are_refused(tmp_path):
    """Arrays by row and by column come back; one byte more in the archive is no array."""
    path = tmp_path / "points.npz"
    stored = {"rows": np.arange(6.0).reshape(2, 3), "columns": np.asfortranarray(np.arange(6).reshape(2, 3))}
    np.savez(path, **stored)
    for name, array in read_npz(path).items():
        np.testing.assert_array_equal(array, stored[name])
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, content + b"x" * (name == "columns.npy"))
    np.testing.assert_array_equal(read_npz(path, ["rows"])["rows"], stored["rows"])
    with pytest.raises(ValueError, match=r"an array of shape \(2, 3\) of int64 has 49 bytes"):
        read_npz(path)
