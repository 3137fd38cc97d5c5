"""A drive written as COLMAP writes it is read as it was planned."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sparsestreet.data.colmap import ColmapReader
from sparsestreet.data.colmap.reader import find_model, read_images
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.posed_images import sort_images
from sparsestreet.data.problems import LogError
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.lenses import BrownConrady, Fisheye, Lens, Rational
from tests.conftest import unchecked
from tests.data.colmap.write import UNIT, Tables, tables, write_binary, write_colmap, write_images, write_text
from tests.data.plan import Plan
from tests.shared import made_once
from tests.typed import there

PLAN = Plan()
WRITERS = {"binary": write_binary, "text": write_text}


@pytest.fixture(scope="module", params=[True, False], ids=["binary", "text"])
def root(request, tmp_path_factory) -> Path:
    name = f"colmap-{'binary' if request.param else 'text'}"
    return made_once(tmp_path_factory, name, lambda folder: write_colmap(folder, PLAN, binary=request.param))


@pytest.fixture(scope="module")
def log(root) -> DrivingLog:
    return ColmapReader(root=root, scale=UNIT).read()


def test_views_are_those_of_the_plan(log):
    assert [view.indices for view in log.views] == [(frame, camera) for frame in range(4) for camera in range(2)]
    for view in log.views:
        frame, number = view.indices
        camera = PLAN.cameras[number]
        pose = log.dataset_from_world @ inverse(view.camera.camera_from_world.double())
        # The world's origin is taken away in float64; what is left is stored in float32.
        np.testing.assert_allclose(pose.numpy(), PLAN.world_from_camera(frame, camera), atol=1e-5)
        np.testing.assert_allclose(view.camera.intrinsics.numpy(), camera.intrinsics, rtol=1e-7)
        assert (log.frames[2 * frame + number].image.numpy() == PLAN.image(frame, camera)).all()


def test_points_are_seeds_and_no_returns(log):
    content = tables(PLAN)
    sparse = there(log.sparse_points)()
    expected = UNIT * np.array([point[0] for point in content.points]) - log.dataset_from_world[:3, 3].numpy()
    np.testing.assert_allclose(sparse.positions.numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(sparse.colors.numpy() * 255, [point[1] for point in content.points], atol=1e-4)
    assert not len(log.sweeps)
    assert all(frame.depth is None for frame in log.frames)


def test_the_notes_say_what_is_not_known(log):
    starts = ("the unit of length", "no lidar", "no boxes", "no clock", "points of the model were made of all images")
    for start in starts:
        assert any(note.startswith(start) for note in log.notes)


def test_it_is_sound_and_hashed_by_what_it_reads(root):
    reader = ColmapReader(root=root)
    assert reader.check() == []
    names = {path.name for path in (*reader.files().described, *reader.files().recorded)}
    assert len(names) == 3 + 4
    assert ColmapReader(root=root, cameras=["left"]).data_hash() != reader.data_hash()


@pytest.mark.parametrize("place", [".", "sparse", "colmap/sparse/0", "my model"])
def test_the_model_may_lie_elsewhere_and_have_no_points(place, tmp_path):
    write_images(tmp_path / "pictures", PLAN)
    write_text(tmp_path / place, tables(PLAN))
    (tmp_path / place / "points3D.txt").unlink()
    log = ColmapReader(root=tmp_path, model="my model" if place == "my model" else None, images="pictures").read()
    assert log.sparse_points is None
    assert "the model has no points" in log.notes
    assert len(log.views) == 8


def test_binary_counts_where_both_are(tmp_path):
    write_images(tmp_path / "images", PLAN)
    write_text(tmp_path, tables(PLAN))
    (tmp_path / "cameras.txt").write_text("broken")
    write_binary(tmp_path, tables(PLAN))
    assert ColmapReader(root=tmp_path).check() == []


F = [30.0, 31.0, 16.0, 12.0]
LENSES: dict[str, tuple[list[float], Lens]] = {
    "SIMPLE_PINHOLE": ([30.0, 16, 12], BrownConrady(fx=30.0, fy=30.0, cx=16.0, cy=12.0)),
    "PINHOLE": (F, BrownConrady(fx=30.0, fy=31.0, cx=16.0, cy=12.0)),
    "SIMPLE_RADIAL": ([30.0, 16, 12, -0.1], BrownConrady(fx=30.0, fy=30.0, cx=16.0, cy=12.0, k1=-0.1)),
    "RADIAL": ([30.0, 16, 12, -0.1, 0.02], BrownConrady(fx=30.0, fy=30.0, cx=16.0, cy=12.0, k1=-0.1, k2=0.02)),
    "OPENCV": (
        [*F, -0.1, 0.02, 1e-3, 2e-3],
        BrownConrady(fx=30.0, fy=31.0, cx=16.0, cy=12.0, k1=-0.1, k2=0.02, p1=1e-3, p2=2e-3),
    ),
    "OPENCV_FISHEYE": (
        [*F, -0.1, 0.02, 1e-3, 2e-3],
        Fisheye(fx=30.0, fy=31.0, cx=16.0, cy=12.0, k1=-0.1, k2=0.02, k3=1e-3, k4=2e-3),
    ),
    "FULL_OPENCV": (
        [*F, 0.3, 0.02, 1e-3, 2e-3, 0.01, 0.4, 0.05, 0.02],
        Rational(
            **{"fx": 30.0, "fy": 31.0, "cx": 16.0, "cy": 12.0, "k1": 0.3, "k2": 0.02, "p1": 1e-3, "p2": 2e-3},
            **{"k3": 0.01, "k4": 0.4, "k5": 0.05, "k6": 0.02},
        ),
    ),
    "SIMPLE_RADIAL_FISHEYE": ([30.0, 16, 12, -0.1], Fisheye(fx=30.0, fy=30.0, cx=16.0, cy=12.0, k1=-0.1)),
    "RADIAL_FISHEYE": ([30.0, 16, 12, -0.1, 0.02], Fisheye(fx=30.0, fy=30.0, cx=16.0, cy=12.0, k1=-0.1, k2=0.02)),
}


def with_lens(model: str, numbers: list[float]) -> Tables:
    return tables(PLAN, {"front": (model, numbers), "left": ("PINHOLE", F)})


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS.keys())
@pytest.mark.parametrize("model", LENSES)
def test_lenses(model, write, tmp_path):
    numbers, lens = LENSES[model]
    write_images(tmp_path / "images", PLAN)
    write(tmp_path, with_lens(model, numbers))
    log = ColmapReader(root=tmp_path).read()
    view = log.views[0]
    torch.testing.assert_close(view.camera.intrinsics, lens.pinhole.float())
    five = lens.brown_conrady()
    if five is None:
        assert any(f"camera front: its lens ({type(lens).__name__}) is none" in note for note in log.notes)
    elif five.any():
        assert torch.equal(there(view.camera.distortion), five.float())
    else:
        assert view.camera.distortion is None
    assert log.views[1].camera.distortion is None


@pytest.mark.parametrize("model", LENSES)
def test_pycolmap_projects_as_the_lens(model):
    """Its numbers in the order of its files, and pixel centers at +0.5."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    numbers, lens = LENSES[model]
    camera = pycolmap.Camera(model=model, width=32, height=24, params=numbers)
    rays = torch.cat((torch.rand(50, 2, dtype=torch.float64) - 0.5, torch.ones(50, 1)), 1)
    expected = np.array([camera.img_from_cam(ray) for ray in rays.numpy()])
    np.testing.assert_allclose(lens.project(rays).numpy(), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS.keys())
def test_pycolmap_reads_the_same(write, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    content = tables(PLAN)
    for index, (position, color, _) in enumerate(content.points):
        content.points[index] = (position, color, 0)  # it wants observations to be of images' points
    for row in content.cameras:
        content.cameras[row] = ("PINHOLE", *content.cameras[row][1:])
    write_images(tmp_path / "images", PLAN)
    write(tmp_path, content)
    _without_observations(tmp_path)
    theirs = pycolmap.Reconstruction(tmp_path)
    log = ColmapReader(root=tmp_path).read()
    names = {f"{PLAN.cameras[camera].name}/{frame + 8}.png": (frame, camera) for frame in range(4) for camera in (0, 1)}
    views = {view.indices: view.camera for view in log.views}
    for image in theirs.images.values():
        pose = np.asarray(image.cam_from_world().matrix())
        world = inverse(log.dataset_from_world).numpy()
        ours = views[names[image.name]].camera_from_world.double().numpy() @ world
        np.testing.assert_allclose(ours[:3], pose, atol=1e-3)
    positions = np.array([point.xyz for point in theirs.points3D.values()])
    ours = there(log.sparse_points)().positions.numpy() + log.dataset_from_world[:3, 3].numpy()
    np.testing.assert_allclose(np.sort(ours, axis=0), np.sort(positions, axis=0), atol=1e-4)


def _without_observations(folder: Path) -> None:
    """Of images: the points that they name are none of the model's."""
    text = folder / "images.txt"
    if text.is_file():
        lines = text.read_text().splitlines()
        text.write_text("\n".join("" if line.startswith("1.5 2.5") else line for line in lines) + "\n")


def camera_row(row: int, value: object):
    """Changes a column of the first camera: model, width, height, numbers."""

    def change(content: Tables) -> None:
        columns: list[Any] = list(content.cameras[3])
        columns[row] = value
        content.cameras[3] = (columns[0], columns[1], columns[2], columns[3])

    return change


def image_row(row: int, value: object):
    """Changes a column of one image: pose, camera, name."""

    def change(content: Tables) -> None:
        columns: list[Any] = list(content.images[7])
        columns[row] = value
        content.images[7] = (columns[0], columns[1], columns[2])

    return change


NAN = float("nan")
DAMAGE = {
    "a lens not read": (camera_row(0, "FOV"), "camera 3 is a FOV, a lens that is not read", [*F, 0.5]),
    "no width": (camera_row(1, 0), "camera 3 has images of 0x24 pixels", None),
    "another size": (camera_row(1, 64), "the image is 32x24, camera front is calibrated for 64x24", None),
    "focal length 0": (camera_row(3, [0.0, 30, 16, 12]), "camera 3: the focal lengths", None),
    "a fisheye folds": (camera_row(0, "OPENCV_FISHEYE"), "folds back", [*F, -3, 0, 0, 0]),
    "no cameras": (lambda content: content.cameras.clear(), "it lists no camera", None),
    "no images": (lambda content: content.images.clear(), "it lists no image", None),
    "a camera is missing": (lambda content: content.cameras.pop(4), "is of camera 4, which cameras", None),
    "an image is missing": (image_row(2, "front/99.png"), "99.png: the file is missing", None),
    "an image twice": (image_row(2, "front/8.png"), "are of one camera and one instant", None),
    "an image outside": (image_row(2, "../front/9.png"), "which is no file below a folder of images", None),
    "an image anywhere": (image_row(2, "/etc/passwd"), "which is no file below a folder of images", None),
    "a pose of zeros": (image_row(0, [0.0] * 7), "is no unit quaternion and translation", None),
    "a pose not finite": (image_row(0, [1.0, 0, 0, 0, NAN, 0, 0]), "is no unit quaternion and translation", None),
    "a pose far away": (image_row(0, [1.0, 0, 0, 0, 9e7, 0, 0]), "poses span", None),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS.keys())
@pytest.mark.parametrize(("change", "said", "numbers"), DAMAGE.values(), ids=DAMAGE.keys())
def test_damage_of_a_table_is_one_clear_error(change, said, numbers, write, tmp_path, pictures):
    content = tables(PLAN)
    change(content)
    if numbers is not None:
        camera_row(3, numbers)(content)
    write(tmp_path, content)
    (tmp_path / "images").symlink_to(pictures)
    problems = ColmapReader(root=tmp_path).check()
    assert {problem.message for problem in problems} == {problems[0].message} or "camera 4" in said
    with pytest.raises(LogError, match=said):
        raise LogError(problems)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    write_images(folder, PLAN)
    return folder


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("sound")
    write_binary(folder, tables(PLAN))
    write_text(folder, tables(PLAN))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def replaced(old: bytes, new: bytes):
    return lambda content: content.replace(old, new, 1)


BYTES = {
    "cameras.bin": {
        "empty": (lambda content: b"", "the file ends within cameras"),
        "cut short": (lambda content: content[:-1], "the file ends within camera 4"),
        "too many": (lambda content: b"\xff" * 8 + content[8:], "it announces .* cameras, but"),
        "too few": (lambda content: b"\1" + content[1:], "bytes follow its last entry"),
        "an unknown model": (lambda content: content[:12] + b"\x63" + content[13:], "has model 99, of which nothing"),
    },
    "images.bin": {
        "cut short": (lambda content: content[:-1], "it announces 1 observations of image 12, but 23 bytes follow"),
        "too many": (lambda content: b"\xff" * 8 + content[8:], "it announces .* images, but"),
        "too many observations": (replaced(b".png\0" + bytes(8), b".png\0" + b"\xff" * 8), "observations of image 5"),
        "a name without end": (lambda content: content[:72] + b"a" * 9000, "a name of more than 4096 bytes"),
        "a name no text": (replaced(b"front/", b"fro\xfft/"), "has a name that is no text"),
    },
    "points3D.bin": {
        "cut short": (lambda content: content[:-1], "the file ends within point"),
        "too many": (lambda content: b"\xff" * 8 + content[8:], "it announces .* points, but"),
        "a track too long": (lambda content: content[:51] + b"\xff" * 8 + content[59:], "the file ends within point 0"),
    },
    "cameras.txt": {
        "an unknown model": (replaced(b"PINHOLE", b"MIRROR"), "line 2: its model is 'MIRROR'"),
        "a number less": (replaced(b" 11.5", b""), "line 2: a PINHOLE has 4 numbers, not 3"),
        "a word": (replaced(b"32", b"wide"), "line 2: it is no camera"),
        "no text": (lambda content: b"\xff\xfe", "the file is no text"),
    },
    "images.txt": {
        "no name": (replaced(b"front/11.png", b""), "line 3: it is no image"),
        "a word": (replaced(b"5 ", b"five "), "line 3: it is no image"),
        "no observations": (lambda content: content.rstrip(), "no line of observations follows it"),
    },
    "points3D.txt": {
        "a word": (replaced(b" 0.5", b"x 0.5"), "line 2: it is no point"),
        "too few words": (lambda content: content + b"7 1 2 3 4\n", "it is no point of three lengths"),
        "a color of 300": (lambda content: content + b"7 1 2 3 4 5 300 0.1\n", "colors from 0 to 255"),
    },
}
CASES = [(name, *case) for name, cases in BYTES.items() for case in cases.values()]


@pytest.mark.parametrize(("name", "change", "said"), CASES, ids=[f"{n}-{k}" for n, c in BYTES.items() for k in c])
def test_damage_of_bytes_is_one_clear_error(name, change, said, sound, pictures, tmp_path):
    damaged = change(sound[name])
    assert damaged != sound[name]
    for other, content in sound.items():
        if other.endswith(Path(name).suffix):
            (tmp_path / other).write_bytes(damaged if other == name else content)
    (tmp_path / "images").symlink_to(pictures)
    problems = ColmapReader(root=tmp_path).check()
    assert [problem.path.name for problem in problems] == [name]
    with pytest.raises(LogError, match=said):
        raise LogError(problems)


def test_a_folder_without_a_model(tmp_path):
    with pytest.raises(LogError, match=r"no cameras and images, \.bin or \.txt, in \., sparse/0, sparse"):
        ColmapReader(root=tmp_path).read()
    assert len(ColmapReader(root=tmp_path / "none").check()) == 1
    for place in ("sparse/0", "sparse/1"):
        (tmp_path / place).mkdir(parents=True)
        for name in ("cameras", "images"):
            (tmp_path / place / f"{name}.bin").touch()
    with pytest.raises(LogError, match="in sparse/2; there are models in sparse/0, sparse/1;"):
        ColmapReader(root=tmp_path, model="sparse/2").read()


@pytest.mark.slow
def test_mutated_files_are_read_or_refused(sound, tmp_path):
    """Nothing else is raised, whatever a few bytes are."""
    random, names = np.random.default_rng(0), ("cameras.bin", "images.bin", "points3D.bin")
    refused = 0
    for number in range(120):
        for name in names:
            content = bytearray(sound[name])
            if name == names[number % 3]:
                for place in random.integers(0, min(len(content), 400), 3):
                    content[place] = random.integers(256)
                del content[len(content) - int(random.integers(0, 2)) :]
            (tmp_path / name).write_bytes(content)
        try:
            with unchecked():
                model = find_model(tmp_path, None)
                sort_images(read_images(model, tmp_path), model.images, cameras=None, first_frame=0, last_frame=-1)
                ColmapReader(root=tmp_path).read_points(there(model.points))
        except LogError:
            refused += 1
    assert 60 < refused < 120


@pytest.mark.parametrize("lines", ["none", "some"])
def test_every_image_is_read_of_a_list_without_lines_of_observations(lines, tmp_path):
    write_colmap(tmp_path, PLAN, binary=False)
    path = tmp_path / "sparse/0/images.txt"
    images = [line for line in path.read_text().splitlines() if line.endswith(".png")]
    if lines == "some":
        images.insert(3, "1.5 2.5 -1 3.5 4.5 7 1 2 3")
        images.append("")
    path.write_text("\n".join(images) + "\n")
    log = ColmapReader(root=tmp_path).read()
    assert [view.indices for view in log.views] == [(frame, camera) for frame in range(4) for camera in range(2)]
    path.write_text("\n".join(line.replace("/", "\\") for line in images) + "\n")
    (tmp_path / "images/front/9.png").unlink()
    log = ColmapReader(root=tmp_path, missing="skip").read()
    assert len(log.views) == 7
    assert "1 of 8 listed images lack files and are left out (data.log.missing=skip)" in log.notes
