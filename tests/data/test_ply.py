"""Points from .ply files, against plyfile; damage."""

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from sparsestreet.data.ply import read_ply
from sparsestreet.data.problems import LogError

POSITIONS = np.random.default_rng(0).normal(0, 50, (40, 3))
COLORS = np.random.default_rng(1).integers(0, 256, (40, 3))


def write(path: Path, kind: str = "f4", color: str | None = "u1", **form: object) -> None:
    """Normals lie between positions and colors, and faces behind the points."""
    columns = [(axis, kind) for axis in ("x", "y", "z", "nx")]
    columns += [(name, color) for name in ("red", "green", "blue")] if color else []
    rows = np.zeros(len(POSITIONS), dtype=columns)
    for index, axis in enumerate("xyz"):
        rows[axis] = POSITIONS[:, index]
    for index, name in enumerate(("red", "green", "blue") if color else ()):
        rows[name] = COLORS[:, index] / (255 if color == "f4" else 1)
    faces = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, **form).write(path)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("form", [{"text": True}, {"byte_order": "<"}, {"byte_order": ">"}], ids=["text", "<", ">"])
@pytest.mark.parametrize(("kind", "color"), [("f4", "u1"), ("f8", "f4"), ("f8", None)])
def test_what_plyfile_writes(form, kind, color, tmp_path):
    write(tmp_path / "a.ply", kind, color, **form)
    positions, colors = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(positions.numpy(), POSITIONS.astype(kind), rtol=1e-6)
    expected = COLORS / 255 if color else np.full((40, 3), 0.5)
    np.testing.assert_allclose(colors.numpy(), expected, atol=1e-6)


def header(*lines: str, start: str = "ply", form: str = "ascii") -> bytes:
    return "\n".join((start, f"format {form} 1.0", *lines, "end_header", "")).encode()


XYZ = [f"property float {axis}" for axis in "xyz"]
DAMAGE = {
    "empty": (b"", "does not start with the line 'ply'"),
    "another format": (b"\x89PNG\r\n", "does not start with the line 'ply'"),
    "no end": (b"ply\n" + b"comment a\n" * 500, "the header does not end within 200 lines"),
    "no line's end": (b"ply\n" + b"a" * 2_000_000, "the header does not end within 200 lines"),
    "no format": (header("element vertex 0", *XYZ, form="zip"), "does not describe points"),
    "no points": (header("element face 2"), "does not describe points"),
    "points behind faces": (header("element face 0", "element vertex 0", *XYZ), "does not describe points"),
    "negative count": (header("element vertex -1", *XYZ), "does not describe points"),
    "no z": (header("element vertex 0", *XYZ[:2]), "does not describe points"),
    "x twice": (header("element vertex 0", *XYZ, XYZ[0]), "does not describe points"),
    "a list": (header("element vertex 1", *XYZ, "property list uchar int at"), "which is no number"),
    "a type unknown": (header("element vertex 1", "property half x"), "'property half x', which is no number"),
    "absurd count": (header("element vertex 999999999999", *XYZ), "999,999,999,999 points, which take"),
    "absurd count in binary": (
        header("element vertex 999999999999", *XYZ, form="binary_little_endian") + bytes(12),
        "points, which take 11,999,999,999,988 bytes, but 12 follow",
    ),
    "cut short": (header("element vertex 2", *XYZ, form="binary_big_endian") + bytes(23), "24 bytes, but 23 follow"),
    "too few lines": (header("element vertex 2", *XYZ) + b"1 2 300000000\n", "point 1 is '', not 3 numbers"),
    "too few numbers": (header("element vertex 1", *XYZ) + b"1 20000\n", "point 0 is '1 20000', not 3 numbers"),
    "a word": (header("element vertex 1", *XYZ) + b"1 2 up\n", "point 0 is '1 2 up', not 3 numbers"),
    "no text": (header("element vertex 1", *XYZ) + b"1 2 \xff\n", "not 3 numbers"),
}


@pytest.mark.parametrize(("content", "said"), DAMAGE.values(), ids=DAMAGE.keys())
def test_damage_is_one_clear_error(content, said, tmp_path):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(LogError, match=said) as caught:
        read_ply(tmp_path / "a.ply")
    assert [problem.path.name for problem in caught.value.problems] == ["a.ply"]


def test_a_file_that_is_missing(tmp_path):
    with pytest.raises(LogError, match="cannot be read"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.slow
@pytest.mark.parametrize("form", [{"text": True}, {"byte_order": "<"}], ids=["text", "binary"])
def test_mutated_files_are_read_or_refused(form, tmp_path):
    path = tmp_path / "a.ply"
    write(path, **form)
    sound, random, refused = path.read_bytes(), np.random.default_rng(0), 0
    for _ in range(200):
        content = bytearray(sound)
        for place in random.integers(0, len(content) // 2, 2):
            content[place] = random.choice(list(b"0123456789 .-\n")) if "text" in form else random.integers(256)
        path.write_bytes(content)
        try:
            positions, colors = read_ply(path)
            assert positions.shape == colors.shape
        except LogError:
            refused += 1
    assert 20 < refused < 200


WHITE = np.array([[200, 100, 50], [0, 255, 3]])
KINDS = {
    "bytes": ("u1", ("red", "green", "blue"), WHITE),
    "16 bits": ("u2", ("red", "green", "blue"), WHITE * 257),
    "bytes in 16 bits": ("u2", ("red", "green", "blue"), WHITE),
    "bytes in 32 bits": ("i4", ("r", "g", "b"), WHITE),
    "fractions": ("f4", ("red", "green", "blue"), WHITE / 255),
    "fractions in doubles, rounded": ("f8", ("r", "g", "b"), WHITE / 254.9),
    "bytes in floats": ("f4", ("red", "green", "blue"), WHITE),
    "16 bits in doubles": ("f8", ("diffuse_red", "diffuse_green", "diffuse_blue"), WHITE * 257),
    "diffuse": ("u1", ("diffuse_red", "diffuse_green", "diffuse_blue"), WHITE),
    "Gaussians": ("f4", ("f_dc_0", "f_dc_1", "f_dc_2"), (WHITE / 255 - 0.5) * 2 * np.sqrt(np.pi)),
    "no names that are known": ("u1", ("c0", "c1", "c2"), np.full((2, 3), 127.5)),
}


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("name", KINDS)
def test_colors_are_read_whatever_they_are_called_and_counted_in(name, text, tmp_path):
    kind, names, values = KINDS[name]
    rows = np.zeros(len(values), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), *((one, kind) for one in names)])
    for index, one in enumerate(names):
        rows[one] = values[:, index]
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(tmp_path / "a.ply")
    expected = np.full((2, 3), 0.5) if name.startswith("no") else WHITE / 255
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply")[1].numpy(), expected, atol=1e-3 if "254" in name else 5e-4)


def test_a_color_that_is_no_number_is_gray(tmp_path):
    rows = np.zeros(2, dtype=[(one, "f4") for one in ("x", "y", "z", "red", "green", "blue")])
    rows["red"], rows["green"] = [np.nan, 255], [np.inf, 51]
    PlyData([PlyElement.describe(rows, "vertex")]).write(tmp_path / "a.ply")
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply")[1].numpy(), [[0.5, 1, 0], [1, 0.2, 0]], atol=1e-6)
