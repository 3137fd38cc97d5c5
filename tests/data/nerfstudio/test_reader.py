"""A drive written as nerfstudio writes it is read as it was planned."""

import math
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.nerfstudio import NerfstudioReader
from sparsestreet.data.problems import LogError, check_missing
from sparsestreet.data.rig import Undistortion
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.lenses import BrownConrady, Fisheye
from tests.data.nerfstudio.write import UNIT, points_of, write_json, write_nerfstudio
from tests.data.plan import Plan
from tests.shared import made_once
from tests.typed import there

PLAN = Plan()


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return made_once(tmp_path_factory, "nerfstudio", lambda folder: write_nerfstudio(folder, PLAN))


@pytest.fixture(scope="module")
def log(root) -> DrivingLog:
    return NerfstudioReader(root=root, scale=UNIT).read()


@pytest.fixture
def written(tmp_path):
    """A folder and its JSON's content, to be changed."""
    return tmp_path, write_nerfstudio(tmp_path, PLAN)


def test_views_are_those_of_the_plan(log):
    assert [view.indices for view in log.views] == [(frame, camera) for frame in range(4) for camera in range(2)]
    for view in log.views:
        frame, number = view.indices
        camera = PLAN.cameras[number]
        pose = there(log.dataset_from_world) @ inverse(view.camera.camera_from_world.double())
        # The world's origin is taken away in float64; what is left is stored in float32.
        np.testing.assert_allclose(pose.numpy(), PLAN.world_from_camera(frame, camera), atol=1e-5)
        np.testing.assert_allclose(view.camera.intrinsics.numpy(), camera.intrinsics, rtol=1e-7)
        assert (view.camera.width, view.camera.height) == (camera.width, camera.height)
        assert view.camera.distortion is None
        assert view.stamp is None
        assert (log.frames[2 * frame + number].image.numpy() == PLAN.image(frame, camera)).all()


def test_points_are_seeds_and_no_returns(log):
    positions, colors = points_of(PLAN)
    sparse = there(log.sparse_points)()
    np.testing.assert_allclose(sparse.positions.numpy(), positions - log.dataset_from_world[:3, 3].numpy(), atol=1e-5)
    np.testing.assert_allclose(sparse.colors.numpy(), colors / 255, atol=1e-6)
    assert not len(log.sweeps)
    assert all(frame.depth is None for frame in log.frames)
    assert not log.tracks


def test_the_notes_say_what_is_not_known(log, root):
    front = np.stack([PLAN.world_from_camera(frame, PLAN.cameras[0])[:3, 3] for frame in range(4)])
    path = np.linalg.norm(np.diff(front, axis=0), axis=1).sum()
    assert any(f"one unit is read as 4 m, so the first camera goes {path:.3g} m" in note for note in log.notes)
    for start in ("no lidar", "no boxes", "no clock", "no sky masks"):
        assert any(note.startswith(start) for note in log.notes)
    with pytest.raises(ValueError, match="scale must be positive meters to a unit, got 0"):
        NerfstudioReader(root=root, scale=0.0).read()


def test_a_window_and_a_camera(root):
    log = NerfstudioReader(root=root, cameras=["images/left"], first_frame=1, last_frame=2, width=16).read()
    assert [view.indices for view in log.views] == [(0, 0), (1, 0)]
    assert (log.views[0].camera.width, log.views[0].camera.height) == (16, 12)
    np.testing.assert_allclose(log.views[0].camera.intrinsics.numpy()[:2], PLAN.cameras[1].intrinsics[:2] / 2)
    with pytest.raises(ValueError, match="must be different ones of the log's"):
        NerfstudioReader(root=root, cameras=["right"]).read()
    with pytest.raises(ValueError, match="frames 0 to 4 are not within"):
        NerfstudioReader(root=root, last_frame=4).read()


def test_it_is_sound_and_hashed_by_what_it_reads(root, written):
    reader = NerfstudioReader(root=root)
    assert reader.check() == []
    folder, content = written
    same = NerfstudioReader(root=folder)
    assert same.data_hash() == reader.data_hash()
    assert NerfstudioReader(root=root, last_frame=2).data_hash() != reader.data_hash()
    content["frames"][0]["fl_x"] += 1
    write_json(folder, content)
    assert same.data_hash() != reader.data_hash()


FISHEYE = {"fl_x": 12.0, "fl_y": 12.5, "cx": 16.25, "cy": 11.5, "k1": -0.02, "k2": 0.004, "k3": 1e-4, "k4": -1e-5}


def at_the_top(content: dict, **values: object) -> dict:
    """One camera: its intrinsics stand at the top, in frames that have none."""
    frames = [
        {key: frame[key] for key in ("file_path", "transform_matrix")}
        for frame in content["frames"]
        if "front" in frame["file_path"]
    ]
    return {"frames": frames, "w": 32, "h": 24} | values


def test_a_fisheye_becomes_a_pinhole(written):
    folder, content = written
    write_json(folder, at_the_top(content, camera_model="OPENCV_FISHEYE", **FISHEYE))
    frame = NerfstudioReader(root=folder, pinhole_fov=130.0).read().frames[1]
    focal = 16 / math.tan(math.radians(65))
    intrinsics = torch.tensor([[focal, 0, 16], [0, focal * 12.5 / 12, 11.5], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(frame.camera.intrinsics, intrinsics.float())
    numbers = {key.replace("l_", ""): value for key, value in FISHEYE.items()}
    take_out = Undistortion.of(Fisheye(**numbers), intrinsics, (32, 24), (32, 24))
    assert (frame.image.numpy() == take_out(PLAN.image(1, PLAN.cameras[0]))).all()
    assert torch.equal(there(frame.ego), there(take_out.blank))


def test_a_lens_is_simulated(written):
    folder, content = written
    focal = {"fl_x": 30.0, "fl_y": 30.5, "cx": 16.25, "cy": 11.5}
    lens = {"k1": -0.2, "k2": 0.03, "p1": 1e-3, "p2": -2e-3, "k3": 1e-3}
    write_json(folder, at_the_top(content, **focal, **lens))
    view = NerfstudioReader(root=folder).read().views[0]
    expected = BrownConrady(fx=30.0, fy=30.5, cx=16.25, cy=11.5, **lens)
    assert torch.equal(there(view.camera.distortion), expected.brown_conrady().float())


def test_a_field_of_view_tells_the_focal_length(written):
    folder, content = written
    write_json(folder, at_the_top(content, camera_angle_x=math.pi / 2) | {"w": None, "h": None})
    view = NerfstudioReader(root=folder).read().views[0]
    expected = torch.tensor([[16.0, 0, 16], [0, 16, 12], [0, 0, 1]])
    torch.testing.assert_close(view.camera.intrinsics, expected, rtol=1e-6, atol=0)


def test_each_field_of_view_goes_with_its_own_side(written):
    """The images are wider than high: 32 by 24 pixels."""
    folder, content = written
    angles = {"camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 3}
    write_json(folder, at_the_top(content, **angles) | {"w": None, "h": None})
    intrinsics = NerfstudioReader(root=folder).read().views[0].camera.intrinsics
    assert (intrinsics[0, 0], intrinsics[1, 1]) == (pytest.approx(16), pytest.approx(12 * math.sqrt(3)))


def test_a_frames_own_numbers_come_before_those_of_all(written):
    folder, content = written
    content |= {"fl_x": 99.0, "w": 7, "camera_model": "OPENCV_FISHEYE", "k1": 0.5}
    for frame in content["frames"]:
        frame["k1"] = 0.0
    write_json(folder, content)
    view = NerfstudioReader(root=folder).read().views[0]
    assert view.camera.intrinsics[0, 0] == PLAN.cameras[0].intrinsics[0, 0]
    assert (view.camera.width, view.camera.distortion) == (32, None)


def test_blenders_names_have_no_ending(written):
    folder, content = written
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
    write_json(folder, content)
    assert len(NerfstudioReader(root=folder).read().views) == 8


def test_images_of_one_folder_with_other_intrinsics_are_another_camera(written):
    folder, content = written
    frames = [frame for frame in content["frames"] if "front" in frame["file_path"]]
    frames[2]["fl_x"] = 33.0
    write_json(folder, {"frames": frames})
    log = NerfstudioReader(root=folder).read()
    assert log.num_cameras == 2
    assert [view.indices for view in log.views] == [(0, 0), (1, 0), (2, 1), (3, 0)]
    assert float(log.views[2].camera.intrinsics[0, 0]) == 33.0
    assert not log.sparse_points


def test_black_pixels_of_a_mask_are_not_used(written):
    folder, content = written
    valid = np.full((24, 32), 255, np.uint8)
    valid[20:] = 0
    Image.fromarray(valid).save(folder / "hood.png")
    content["frames"][0]["mask_path"] = "hood.png"
    write_json(folder, content)
    frames = NerfstudioReader(root=folder).read().frames
    assert torch.equal(there(frames[0].ego), torch.from_numpy(valid == 0))
    assert frames[1].ego is None
    user = folder / "masks" / "ego" / "images" / "front"
    user.mkdir(parents=True)
    column = np.zeros((24, 32), np.uint8)
    column[:, 0] = 255
    for frame in range(4):
        Image.fromarray(column).save(user / f"frame_{frame + 8}.png")
    frame = NerfstudioReader(root=folder, masks=folder / "masks").read().frames[0]
    assert torch.equal(there(frame.ego), torch.from_numpy((valid == 0) | (column > 0)))


def test_times_order_the_frames(written):
    folder, content = written
    for frame in content["frames"]:
        number = int(frame["file_path"].split("_")[-1].removesuffix(".png")) - 8
        frame["time"] = (3 - number) / 3
    write_json(folder, content)
    log = NerfstudioReader(root=folder, scale=UNIT).read()
    assert (log.frames[0].image.numpy() == PLAN.image(3, PLAN.cameras[0])).all()
    assert [view.indices for view in log.views][:3] == [(0, 0), (0, 1), (1, 0)]
    assert any("they are no clock" in note for note in log.notes)


def test_points_in_binary(tmp_path, log):
    write_nerfstudio(tmp_path, PLAN, text=False)
    sparse = there(NerfstudioReader(root=tmp_path, scale=UNIT).read().sparse_points)()
    torch.testing.assert_close(sparse.positions, there(log.sparse_points)().positions, rtol=0, atol=1e-5)
    assert torch.equal(sparse.colors, there(log.sparse_points)().colors)


def frame_with(**values: object):
    return lambda content: content["frames"][3].update(values)


def top_with(**values: object):
    return lambda content: content.update(values)


def without(key: str):
    return lambda content: content["frames"][3].pop(key)


EYE = np.eye(4).tolist()
DAMAGE = {
    "no frames": (top_with(frames=None), "has no 'frames'"),
    "frames of none": (top_with(frames=[]), "frames is empty"),
    "frames no list": (top_with(frames={"a": 1}), "frames is an object of 1, not a list"),
    "no file": (without("file_path"), r"frames\[3\] has no 'file_path'"),
    "file no text": (frame_with(file_path=3), r"frames\[3\]\.file_path is 3, not a text"),
    "file outside": (frame_with(file_path="../a.png"), "no file below the folder of transforms.json"),
    "file absolute": (frame_with(file_path="/etc/passwd"), "no file below the folder"),
    "file with a zero": (frame_with(file_path="a\0.png"), "no file below the folder"),
    "file missing": (frame_with(file_path="images/front/none.png"), "none.png: the file is missing"),
    "file twice": (lambda content: content["frames"].append(content["frames"][0]), "are of one camera and one instant"),
    "no pose": (without("transform_matrix"), r"frames\[3\] has no 'transform_matrix'"),
    "pose of 2 rows": (frame_with(transform_matrix=EYE[:2]), r"transform_matrix has 2 rows, not 4"),
    "pose of words": (frame_with(transform_matrix=[["a"] * 4] * 4), r"transform_matrix\[0\]\[0\] is 'a', not a number"),
    "pose not finite": (frame_with(transform_matrix=[[math.nan] * 4] * 4), "must be finite, it is nan"),
    "pose scaled": (frame_with(transform_matrix=(2 * np.eye(4)).tolist()), "the pose of .* is no rigid transform"),
    "pose far away": (frame_with(transform_matrix=[*EYE[:2], [0, 0, 1, 9e7], EYE[3]]), "poses span"),
    "no focal length": (without("fl_x"), r"frames\[3\] has no 'fl_x', nor has the top of the file"),
    "focal length 0": (frame_with(fl_x=0), r"frames\[3\]\.fl_x must be positive, it is 0"),
    "focal length huge": (frame_with(fl_x=10**400), "fl_x must be positive, it is a number of too many digits"),
    "angle too wide": (lambda content: (without("fl_x")(content), top_with(camera_angle_x=4.0)(content)), "4 radians"),
    "width half": (frame_with(w=31.5), "w must be a whole number from 1 to 100000, it is 31.5"),
    "another size": (frame_with(w=64), "the image is 32x24, camera .* is calibrated for 64x24"),
    "a lens unknown": (frame_with(camera_model="EQUIRECTANGULAR"), "'EQUIRECTANGULAR', a lens that is not read"),
    "a fisheye folds": (frame_with(camera_model="OPENCV_FISHEYE", k1=-3.0), "folds back"),
    "k4 of a pinhole": (frame_with(k4=0.1), "this model has no k4"),
    "a time not finite": (frame_with(time=math.nan), r"frames\[3\]\.time is nan, no time"),
    "some times": (frame_with(time=0.5), "has a time in 1 of 8 frames"),
    "no mask": (frame_with(mask_path="none.png"), "none.png: the file is missing"),
    "no points": (top_with(ply_file_path="none.ply"), "none.ply: the file is missing"),
}


@pytest.mark.parametrize(("change", "said"), DAMAGE.values(), ids=DAMAGE.keys())
def test_damage_of_the_table_is_one_clear_error(change, said, root, tmp_path, content):
    (tmp_path / "images").symlink_to(root / "images")
    (tmp_path / "sparse_pc.ply").symlink_to(root / "sparse_pc.ply")
    changed = deepcopy(content)
    change(changed)
    write_json(tmp_path, changed)
    problems = NerfstudioReader(root=tmp_path).check()
    assert len(problems) == 1, problems
    with pytest.raises(LogError, match=said):
        NerfstudioReader(root=tmp_path).read()
    with pytest.raises(LogError, match=said):
        raise LogError(problems)


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    return write_nerfstudio(tmp_path_factory.mktemp("content"), PLAN)


TEXTS = {
    "no file": (None, "transforms.json: the file is missing"),
    "nothing": (b"", "is no JSON"),
    "cut short": (b'{"frames": [', "is no JSON"),
    "no text": (b"\xff\xfe\x00", "is no JSON"),
    "deep": (b"[" * 200_000, "is no JSON"),
    "named twice": (b'{"frames": [], "frames": []}', "names 'frames' twice"),
    "a number": (b"7", "the file is 7, not an object"),
    "too many digits": (b'{"frames": ' + b"9" * 5000 + b"}", "is no JSON"),
}


@pytest.mark.parametrize(("text", "said"), TEXTS.values(), ids=TEXTS.keys())
def test_what_is_no_json(text, said, tmp_path):
    if text is not None:
        (tmp_path / "transforms.json").write_bytes(text)
    with pytest.raises(LogError, match=said):
        NerfstudioReader(root=tmp_path).read()
    assert len(NerfstudioReader(root=tmp_path).check()) == 1


def test_broken_pixels_and_points_are_found_by_the_check(written):
    folder, _ = written
    name = folder / "images/front/frame_9.png"
    pixels = bytearray(name.read_bytes())
    pixels[60:80] = bytes(20)
    name.write_bytes(pixels)
    (folder / "sparse_pc.ply").write_text("ply\nformat ascii 1.0\nelement vertex 2\nend_header\n")
    reader = NerfstudioReader(root=folder)
    log = reader.read()  # nothing large is decoded
    assert [problem.path.name for problem in reader.check()] == ["frame_9.png", "sparse_pc.ply"]
    with pytest.raises(LogError, match=r"2 problems in the log:\n.*frame_9\.png: the image cannot be decoded"):
        log.frames[2]  # explained by all that a check finds
    with pytest.raises(LogError, match=r"sparse_pc\.ply: the header does not describe points"):
        there(log.sparse_points)()


def test_a_transparent_pixel_is_not_used_nor_is_its_color(written):
    folder, _ = written
    clear = np.zeros((24, 32), bool)
    clear[3:, :7] = True
    for frame in range(4):
        pixels = PLAN.image(frame, PLAN.cameras[0]).copy()
        pixels[clear] = (255, 0, 255)
        Image.fromarray(np.dstack([pixels, 255 * ~clear]).astype(np.uint8)).save(
            folder / f"images/front/frame_{frame + 8}.png"
        )
    log = NerfstudioReader(root=folder).read()
    assert "4 images of camera images/front have alpha" in " ".join(log.notes)
    assert torch.equal(there(log.frames[2].ego), torch.from_numpy(clear))
    assert log.frames[3].ego is None


def test_instant_ngps_flag_is_a_fisheye_and_what_nothing_reads_is_said(written):
    folder, content = written
    flagged = at_the_top(content, is_fisheye=True, **FISHEYE) | {"aabb_scale": 16, "train_filenames": []}
    flagged["frames"][1]["exposure"] = 0.1
    write_json(folder, flagged)
    named = NerfstudioReader(root=folder).read()
    write_json(folder, at_the_top(content, camera_model="OPENCV_FISHEYE", **FISHEYE))
    assert torch.equal(named.frames[1].image, NerfstudioReader(root=folder).read().frames[1].image)
    assert "nothing reads train_filenames, exposure of transforms.json" in named.notes


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"is_fisheye": True, "camera_model": "OPENCV"}, "is_fisheye is True, but camera_model is OPENCV"),
        ({"is_fisheye": True, "p1": 0.1}, "p1 is not 0, but this model has no p1"),
        ({"k6": 0.1}, "k6 is not 0, but this model has no k6"),
        ({"ftheta_p0": 1.0}, "has 'ftheta_p0', a lens that is not read"),
    ],
)
def test_numbers_that_contradict_the_lens_are_refused(values, said, written):
    folder, content = written
    write_json(folder, at_the_top(content, fl_x=30.0, **values))
    with pytest.raises(LogError, match=said):
        NerfstudioReader(root=folder).read()


def test_scattered_missing_images_can_be_left_out(written):
    folder, content = written
    for name in ("front/frame_9", "left/frame_9", "left/frame_10"):
        (folder / f"images/{name}.png").unlink()
    with pytest.raises(LogError, match=r"data\.log\.missing=skip"):
        NerfstudioReader(root=folder).read()
    for frame in content["frames"]:
        frame["w"] = frame["h"] = None  # sizes are then those of the files
    write_json(folder, content)
    reader = NerfstudioReader(root=folder, missing="skip")
    assert reader.check() == []
    log = reader.read()
    assert "3 of 8 listed images lack files and are left out (data.log.missing=skip)" in log.notes
    assert [view.indices for view in log.views] == [(0, 0), (0, 1), (1, 0), (2, 0), (2, 1)]
    with pytest.raises(ValueError, match="missing must be one of error, skip, got 'drop'"):
        check_missing("drop")
    for path in (folder / "images").rglob("*.png"):
        path.unlink()
    with pytest.raises(LogError, match="has 8 frames, and the image of none is there"):
        reader.read()


def test_files_named_on_windows_and_times_in_nanoseconds(written):
    folder, content = written
    for frame in content["frames"]:
        number = int(frame["file_path"].split("_")[-1].removesuffix(".png"))
        frame["file_path"] = frame["file_path"].replace("/", "\\")
        # A float has steps of 256 here.
        frame["time"] = 1_700_000_000_000_000_000 - number
    write_json(folder, content)
    log = NerfstudioReader(root=folder).read()
    assert log.camera_names == ("images/front", "images/left")
    assert (log.frames[0].image.numpy() == PLAN.image(3, PLAN.cameras[0])).all()
    content["frames"][0]["file_path"] = "C:\\drive\\000.png"
    write_json(folder, content)
    with pytest.raises(LogError, match="no file below the folder of transforms"):
        NerfstudioReader(root=folder).read()


def test_masks_of_the_user_are_decoded_by_the_check(written):
    folder, _ = written
    user = folder / "masks" / "sky" / "images" / "left"
    user.mkdir(parents=True)
    labels = np.tile(np.array([0, 2, 10, 2], np.uint8), (24, 8))
    for frame in range(4):
        Image.fromarray(labels if frame == 2 else 0 * labels).save(user / f"frame_{frame + 8}.png")
    (problem,) = NerfstudioReader(root=folder, masks=folder / "masks").check()
    assert (problem.path.name, "3 values" in problem.message) == ("frame_10.png", True)
