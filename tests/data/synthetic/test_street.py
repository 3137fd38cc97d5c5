"""A tiny street on disk: complete, exact, repeatable; made whole or not at all."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.synthetic import StreetReader
from sparsestreet.data.synthetic import street as street_files
from sparsestreet.data.synthetic.capture import street_camera
from sparsestreet.data.synthetic.models import Clothes, Pedestrian
from sparsestreet.data.synthetic.render import StreetFrame, StreetImage, StreetSweep
from sparsestreet.data.synthetic.settings import WAYMO_TOP, StreetSettings
from sparsestreet.data.synthetic.street import StreetWriter, joint_rotations, make_street, noisy_box, noisy_camera
from sparsestreet.data.synthetic.tracer import at
from sparsestreet.data.synthetic.world import build_world
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.skeleton import HEIGHT, JOINTS, posed_bones, rest_joints

pytestmark = pytest.mark.lengthy

TINY = StreetSettings(
    seed=3, num_frames=3, width=97, height=61, num_cameras=2, frame_rate=2.0, num_parked_cars=8, num_moving_cars=3,
    num_pedestrians=3, num_cyclists=1, annotation_range=25.0,
    lidar=replace(WAYMO_TOP, beams=16, azimuth_steps=200),
)  # fmt: skip
VIEWS = [(frame, camera) for frame in range(3) for camera in range(2)]


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Path:
    return make_street(TINY, tmp_path_factory.mktemp("streets") / "tiny")


def truth(street: Path, frame: int, camera: int) -> tuple[np.ndarray, np.ndarray]:
    with np.load(street / f"depth/{frame:03d}_{camera}.npz") as stored:
        return stored["depth"], stored["instance"]


def mask(street: Path, folder: str, frame: int, camera: int) -> np.ndarray:
    values = np.array(Image.open(street / folder / f"{frame:03d}_{camera}.png"))
    assert set(np.unique(values)) <= {0, 255}
    return values == 255


def pinhole(street: Path, frame: int, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics and world_from_camera as a reader would take them."""
    fx, fy, cx, cy, *distortion = np.loadtxt(street / f"intrinsics/{camera}.txt")
    assert len(distortion) == 5
    assert not any(distortion)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.loadtxt(street / f"extrinsics/{frame:03d}_{camera}.txt")


def unprojected(street: Path, frame: int, camera: int) -> np.ndarray:
    """World points of all pixels, [h, w, 3]; meaningless in the sky."""
    depth, _ = truth(street, frame, camera)
    intrinsics, world_from_camera = pinhole(street, frame, camera)
    v, u = np.meshgrid(np.arange(61) + 0.5, np.arange(97) + 0.5, indexing="ij")
    rays = np.stack((u, v, np.ones_like(u)), -1) @ np.linalg.inv(intrinsics).T
    return (rays * depth[..., None]) @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]


def instances(street: Path) -> dict[int, dict]:
    return {
        int(key): value for key, value in json.loads((street / "instances/instances_info.json").read_text()).items()
    }


def boxes(street: Path, frame: int) -> dict[int, tuple[np.ndarray, np.ndarray, str]]:
    """Id -> (world_from_object, size, class) of the objects annotated in a frame."""
    found = {}
    for key, instance in instances(street).items():
        notes = instance["frame_annotations"]
        if frame in notes["frame_idx"]:
            position = notes["frame_idx"].index(frame)
            pose, size = np.array(notes["obj_to_world"][position]), np.array(notes["box_size"][position])
            found[key] = (pose, size, instance["class_name"])
    return found


def test_all_files_are_there(street):
    views = [f"{frame:03d}_{camera}" for frame, camera in VIEWS]
    expected = {"street.json", "timestamps.txt", "instances/instances_info.json", "instances/frame_instances.json"}
    expected |= {f"intrinsics/{camera}.txt" for camera in range(2)} | {"humanpose/smpl.pkl"}
    for folder, kind in (
        ("images", "jpg"), ("extrinsics", "txt"), ("sky_masks", "png"), ("depth", "npz"),
        *((f"dynamic_masks/{name}", "png") for name in ("all", "human", "vehicle")),
    ):  # fmt: skip
        expected |= {f"{folder}/{view}.{kind}" for view in views}
    expected |= {f"lidar/{frame:03d}.bin" for frame in range(3)} | {f"lidar_pose/{frame:03d}.txt" for frame in range(3)}
    found = {str(path.relative_to(street)) for path in street.rglob("*") if path.is_file()}
    assert found == expected


def test_images_are_pictures(street):
    for frame, camera in VIEWS:
        image = np.array(Image.open(street / f"images/{frame:03d}_{camera}.jpg"))
        assert image.shape == (61, 97, 3)
        assert 60 < image.mean() < 200
        assert image.std() > 25


def test_boxes_contain_the_points_of_their_pixels_and_enclose_them_in_the_image(street):
    seen = 0
    for frame, camera in VIEWS:
        points, (_, ids) = unprojected(street, frame, camera), truth(street, frame, camera)
        intrinsics, world_from_camera = pinhole(street, frame, camera)
        for key, (pose, size, _) in boxes(street, frame).items():
            mine = ids == key
            if not mine.any():
                continue
            seen += 1
            local = (points[mine] - pose[:3, 3]) @ pose[:3, :3]
            # Float32 depth at 60 m is good to 4e-6 m; the rest is room for rounding of the poses.
            assert (np.abs(local) <= size / 2 + 2e-3).all()
            corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2
            in_camera = (corners @ pose[:3, :3].T + pose[:3, 3] - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
            if (in_camera[:, 2] > 0.1).all():
                pixels = in_camera @ intrinsics.T
                pixels = pixels[:, :2] / pixels[:, 2:]
                v, u = np.nonzero(mine)
                centers = np.stack((u, v), 1) + 0.5
                assert (centers >= pixels.min(0) - 1e-2).all()
                assert (centers <= pixels.max(0) + 1e-2).all()
    assert seen >= 15


def test_depth_puts_the_road_on_the_ground(street):
    """Pixels of the lower rows that are no object lie on the road, the footway or a wall above them."""
    on_road = 0
    for frame, camera in VIEWS:
        points, (_, ids) = unprojected(street, frame, camera), truth(street, frame, camera)
        free = points[(ids < 0) & ~mask(street, "sky_masks", frame, camera)]
        assert free[:, 2].min() > -1e-3
        lane = free[np.abs(free[:, 1]) < 1.5]
        lane = lane[lane[:, 0] < 50]
        np.testing.assert_allclose(lane[:, 2], 0, atol=1e-3)
        on_road += len(lane)
    assert on_road > 1000


def test_masks_are_exactly_the_instances(street):
    for frame, camera in VIEWS:
        depth, ids = truth(street, frame, camera)
        annotated = boxes(street, frame)
        assert set(np.unique(ids)) - {-1} <= set(annotated)
        human = [key for key, (_, _, class_name) in annotated.items() if class_name in ("Pedestrian", "Cyclist")]
        vehicle = [key for key, (_, _, class_name) in annotated.items() if class_name == "Vehicle"]
        np.testing.assert_array_equal(mask(street, "dynamic_masks/all", frame, camera), ids >= 0)
        np.testing.assert_array_equal(mask(street, "dynamic_masks/human", frame, camera), np.isin(ids, human))
        np.testing.assert_array_equal(mask(street, "dynamic_masks/vehicle", frame, camera), np.isin(ids, vehicle))
        np.testing.assert_array_equal(mask(street, "sky_masks", frame, camera), depth == 0)


def test_tracks_follow_the_world_and_every_frame_is_listed(street):
    world = build_world(TINY)
    actors = {actor.name: actor for actor in world.actors}
    listed = json.loads((street / "instances/frame_instances.json").read_text())
    assert list(listed) == ["0", "1", "2"]
    info = instances(street)
    assert list(info) == list(range(len(info)))
    assert {instance["class_name"] for instance in info.values()} >= {"Vehicle", "Cyclist"}
    for key, instance in info.items():
        notes, actor = instance["frame_annotations"], actors[instance["id"]]
        assert instance["class_name"] == actor.model.class_name
        for frame, pose, size in zip(notes["frame_idx"], notes["obj_to_world"], notes["box_size"], strict=True):
            assert key in listed[str(frame)]
            np.testing.assert_array_equal(pose, actor.pose(frame / 2.0))
            assert size == list(actor.model.size)
            ego = world.ego.pose(frame / 2.0)[:2, 3]
            assert np.linalg.norm(np.array(pose)[:2, 3] - ego) <= TINY.annotation_range
    assert sum(map(len, listed.values())) == sum(len(i["frame_annotations"]["frame_idx"]) for i in info.values())


def test_lidar_points_lie_on_what_the_cameras_see(street):
    checked = 0
    for frame, camera in VIEWS:
        points = np.fromfile(street / f"lidar/{frame:03d}.bin", np.float32).reshape(-1, 4)
        assert ((points[:, 3] >= 0) & (points[:, 3] <= 1)).all()
        pose = np.loadtxt(street / f"lidar_pose/{frame:03d}.txt")
        intrinsics, world_from_camera = pinhole(street, frame, camera)
        world = points[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        in_camera = (world - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
        in_camera = in_camera[in_camera[:, 2] > 1]
        pixels = in_camera @ intrinsics.T
        u, v = np.floor(pixels[:, :2] / pixels[:, 2:]).astype(int).T
        inner = (u >= 1) & (u < 96) & (v >= 1) & (v < 60)
        u, v, z = u[inner], v[inner], in_camera[inner, 2]
        depth, _ = truth(street, frame, camera)
        depth = np.where(depth == 0, np.inf, depth)
        around = np.stack([depth[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
        # The surface passes through the 3x3 pixels around; range noise is 0.02 m, so 0.1 m is five of it.
        fits = (z > around.min(0) - 0.1) & (z < around.max(0) + 0.1)
        # The sensor stands 0.7 m behind the cameras and sees a little past what hides things from them.
        assert fits.mean() > 0.95
        checked += len(z)
    assert checked > 1000


def digest(root: Path) -> dict[str, str]:
    """Hash of every file but the compressed archives, which hold the time of writing; those by their arrays."""
    hashes = {}
    for path in sorted(root.rglob("*")):
        if path.suffix == ".npz":
            with np.load(path) as stored:
                content = b"".join(stored[name].tobytes() for name in sorted(stored))
        elif path.is_file():
            content = path.read_bytes()
        else:
            continue
        hashes[str(path.relative_to(root))] = hashlib.sha256(content).hexdigest()
    return hashes


def test_equal_settings_give_equal_bytes_and_other_seeds_other_streets(street, tmp_path):
    again = make_street(TINY, tmp_path / "again")
    assert digest(again) == digest(street)
    other = make_street(replace(TINY, seed=4, num_frames=1), tmp_path / "other")
    first, second = (np.array(Image.open(root / "images/000_0.jpg"), int) for root in (street, other))
    assert np.abs(first - second).mean() > 15


def test_a_finished_street_is_reused(street):
    calls = []
    before = (street / "street.json").stat().st_mtime_ns
    assert make_street(TINY, street, lambda done, total: calls.append(done)) == street
    assert calls == []
    assert (street / "street.json").stat().st_mtime_ns == before


def test_another_folder_is_not_touched(street, tmp_path):
    with pytest.raises(FileExistsError, match="choose another folder"):
        make_street(replace(TINY, seed=4), street)
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="exactly these settings"):
        make_street(TINY, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_an_interruption_leaves_nothing(tmp_path):
    small = replace(
        TINY,
        num_cameras=1,
        supersampling=1,
        width=16,
        height=9,
        lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16),
    )

    def interrupt(done: int, total: int) -> None:
        assert total == 3
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_street(small, tmp_path / "street", interrupt)
    assert list(tmp_path.iterdir()) == []
    calls = []
    make_street(small, tmp_path / "street", lambda done, total: calls.append((done, total)))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert [path.name for path in tmp_path.iterdir()] == ["street"]


def test_a_street_without_objects(tmp_path):
    empty = StreetSettings(
        num_frames=1, width=16, height=9, num_cameras=1, supersampling=1, num_parked_cars=0,
        num_moving_cars=0, num_pedestrians=0, num_cyclists=0, lidar=replace(WAYMO_TOP, beams=4, azimuth_steps=8),
    )  # fmt: skip
    root = make_street(empty, tmp_path / "empty")
    assert json.loads((root / "instances/frame_instances.json").read_text()) == {"0": []}
    assert json.loads((root / "instances/instances_info.json").read_text()) == {}
    assert not np.array(Image.open(root / "dynamic_masks/all/000_0.png")).any()


def test_a_box_needs_six_pixels_or_three_returns_and_a_body_six_pixels_of_one_camera(tmp_path, monkeypatch):
    settings = StreetSettings(
        num_frames=1, width=16, height=9, num_cameras=2, num_parked_cars=0, num_moving_cars=0, num_cyclists=0,
        num_pedestrians=5, annotation_range=1000.0,
    )  # fmt: skip
    world = build_world(settings)
    # Of five people: pixels in both cameras, and returns.
    pixels, returns = np.array([[5, 3, 0, 0, 0], [0, 3, 6, 0, 0]]), [0, 0, 0, 3, 2]
    ego, images = world.ego.pose(0.0), []
    for camera, counts in enumerate(pixels):
        seen = np.full((9, 16), -1, np.int16)
        seen.flat[: counts.sum()] = np.repeat(np.arange(5), counts)
        blank, sky = np.zeros((9, 16), np.float32), np.zeros((9, 16), bool)
        rgb = np.zeros((9, 16, 3), np.uint8)
        images.append(StreetImage(street_camera(settings, camera, ego), rgb, blank, seen, sky))
    hit = np.repeat(np.arange(5), returns).astype(np.int16)
    sweep = StreetSweep(np.zeros((5, 4), np.float32), hit, ego)
    with_bodies = []
    monkeypatch.setattr(street_files, "pickled_people", lambda people: with_bodies.extend(people) or b"")
    writer = StreetWriter(tmp_path, settings, world)
    writer.write_frame(StreetFrame(0, ego, tuple(images), sweep, tuple(actor.pose(0.0) for actor in world.actors)))
    writer.finish()
    assert [one["id"] for one in instances(tmp_path).values()] == ["pedestrian_01", "pedestrian_02", "pedestrian_03"]
    assert [instances(tmp_path)[key]["id"] for key in with_bodies] == ["pedestrian_02"]


NOISY = StreetSettings(
    seed=3, num_frames=2, width=48, height=30, num_cameras=2, frame_rate=2.0, supersampling=1, num_parked_cars=4,
    num_moving_cars=2, num_pedestrians=1, num_cyclists=0, lidar=replace(WAYMO_TOP, beams=8, azimuth_steps=100),
    pose_noise=(0.2, 1.0), box_noise=(0.3, 2.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def roots(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("streets")
    clean = make_street(replace(NOISY, pose_noise=(), box_noise=()), folder / "clean")
    return clean, make_street(NOISY, folder / "noisy")


def test_only_the_files_of_poses_and_boxes_differ(roots):
    clean, noisy = roots
    files = {path.relative_to(clean) for path in clean.rglob("*") if path.is_file()}
    assert files == {path.relative_to(noisy) for path in noisy.rglob("*") if path.is_file()}
    changed = {path for path in files if (clean / path).read_bytes() != (noisy / path).read_bytes()}
    poses = {Path(f"extrinsics/{frame:03d}_{camera}.txt") for frame in range(2) for camera in range(2)}
    assert changed == poses | {Path("instances/instances_info.json"), Path("street.json")}


def test_files_say_the_noise_around_what_is_true(roots):
    """Boxes against the world's actors, images against the rig; 99.9 % of three normal numbers are below 3.5 rms."""
    world, (_, root) = build_world(NOISY), roots
    for frame in range(2):
        for camera in range(2):
            true = street_camera(NOISY, camera, world.ego.pose(frame / 2)).world_from_camera
            motion = np.linalg.inv(true) @ np.loadtxt(root / f"extrinsics/{frame:03d}_{camera}.txt")
            assert 1e-3 < np.linalg.norm(motion[:3, 3]) < 3.5 * 0.2
            assert 1e-3 < np.degrees(np.arccos((np.trace(motion[:3, :3]) - 1) / 2)) < 3.5
    actors = {actor.name: actor for actor in world.actors}
    objects = json.loads((root / "instances/instances_info.json").read_text()).values()
    assert len(objects) > 3
    for one in objects:
        notes = one["frame_annotations"]
        for frame, said in zip(notes["frame_idx"], notes["obj_to_world"], strict=True):
            motion = np.linalg.inv(actors[one["id"]].pose(frame / 2)) @ np.array(said)
            assert 1e-3 < np.linalg.norm(motion[:3, 3]) < 3.5 * 0.3
            np.testing.assert_allclose(motion[2, :3], (0, 0, 1), atol=1e-12)
            assert 0 < abs(np.degrees(np.arctan2(motion[1, 0], motion[0, 0]))) < 3.5 * 2


def test_noise_has_the_size_of_the_settings():
    """Root mean squares of 500 motions: the standard error of the poorest is 3 %."""
    pose = at(3.0, 2.0, 1.0, 0.7)
    images = [np.linalg.inv(pose) @ noisy_camera(NOISY, pose, frame, 1) for frame in range(500)]
    boxes = [np.linalg.inv(pose) @ noisy_box(NOISY, pose, "a car", frame) for frame in range(500)]
    for motions, meters, degrees in ((images, 0.2, 1.0), (boxes, 0.3, 2.0)):
        moved = np.array([motion[:3, 3] for motion in motions])
        turned = np.degrees([np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1)) for motion in motions])
        np.testing.assert_allclose(np.sqrt((moved**2).sum(1).mean()), meters, rtol=0.06)
        np.testing.assert_allclose(moved.std(0), meters / np.sqrt(3), rtol=0.12)
        np.testing.assert_allclose(np.sqrt((turned**2).mean()), degrees, rtol=0.07)


GRAY = Clothes(*((0.5, 0.5, 0.5),) * 4)
PERSON = Pedestrian(1.6, GRAY)
PHASES = np.arange(8) / 8 * PERSON.stride


def posed_joints(person: Pedestrian, rotations: np.ndarray) -> dict[str, np.ndarray]:
    """Joints in axes of the box about the pelvis, of a body as tall as the person."""
    joints = (person.height / HEIGHT * rest_joints().double())[None]
    joints = joints - joints[:, :1]
    bones = posed_bones(joints, quat.from_matrix(torch.from_numpy(rotations))[None]).transforms[0]
    places = (bones[..., :3] @ joints[0, :, :, None])[..., 0] + bones[..., 3]
    return dict(zip(JOINTS, places.numpy(), strict=True))


@pytest.mark.parametrize("traveled", PHASES)
def test_joints_are_where_the_limbs_are(traveled):
    joints = posed_joints(PERSON, joint_rotations(PERSON, float(traveled)))
    distances = {}
    for side, name in ((1, "left"), (-1, "right")):
        limbs = (*PERSON.leg(side, traveled), *PERSON.arm(side, traveled))
        rendered = dict(zip(("hip", "knee", "ankle", "shoulder", "elbow", "wrist"), limbs, strict=True))
        distances |= {f"{name}_{joint}": joints[f"{name}_{joint}"] - place for joint, place in rendered.items()}
    # The pelvis is where it brings the hips together; the rendered limbs change their length with the gait.
    pelvis = (distances["left_hip"] + distances["right_hip"]) / 2
    farthest = {name: np.linalg.norm(distance - pelvis) for name, distance in distances.items()}
    assert max(farthest.values()) < 0.1, farthest


def test_limbs_point_exactly_where_they_are_rendered():
    joints = posed_joints(PERSON, joint_rotations(PERSON, 0.3))
    for side, name in ((1, "left"), (-1, "right")):
        hip, knee, foot = np.array(PERSON.leg(side, 0.3))
        shoulder, elbow, hand = np.array(PERSON.arm(side, 0.3))
        for start, end, direction in (
            ("hip", "knee", knee - hip), ("knee", "ankle", foot - knee),
            ("shoulder", "elbow", elbow - shoulder), ("elbow", "wrist", hand - elbow),
        ):  # fmt: skip
            bone = joints[f"{name}_{end}"] - joints[f"{name}_{start}"]
            assert bone @ direction / np.linalg.norm(bone) / np.linalg.norm(direction) == pytest.approx(1, abs=1e-9)


SETTINGS = StreetSettings(
    seed=4, num_frames=6, width=96, height=60, num_cameras=2, supersampling=1, frame_rate=2.0, num_parked_cars=0,
    num_moving_cars=0, num_cyclists=1, num_pedestrians=4, lidar=replace(WAYMO_TOP, beams=4, azimuth_steps=40),
)  # fmt: skip


def test_a_street_is_read_with_its_bodies(tmp_path):
    exact, noisy = (
        StreetReader(replace(SETTINGS, body_pose_noise=noise), tmp_path / str(noise)) for noise in (0.0, 3.0)
    )
    log, others = exact.read(), noisy.read().tracks
    world = build_world(SETTINGS)
    actors = [(actor.model, actor.path) for actor in world.actors if isinstance(actor.model, Pedestrian)]
    people = [track for track in log.tracks if track.body is not None]
    assert 1 < len(people) <= len(actors)
    assert all(track.body is None for track in log.tracks if track.class_name != "Pedestrian")
    angles = []
    for track in people:
        person, path = min(actors, key=lambda actor: abs(actor[0].height - float(track.size[2])))
        other = next(again for again in others if again.name == track.name)
        assert other.body.valid.tolist() == track.body.valid.tolist()
        for place in track.body.valid.nonzero().flatten().tolist():
            rotations = joint_rotations(person, path.traveled(int(track.frames[place]) / SETTINGS.frame_rate))
            rotations[0] = track.world_from_object[place, :3, :3].numpy() @ rotations[0]
            expected = quat.from_matrix(torch.from_numpy(rotations)).float()
            cosines = (track.body.rotations[place] * expected).sum(1).abs()
            assert float(cosines.min()) > 1 - 1e-6
            between = (track.body.rotations[place] * other.body.rotations[place]).sum(1).abs().clamp(max=1)
            angles += torch.rad2deg(2 * between.acos()).tolist()
    # 24 joints in a dozen poses: a root mean square is known to 1 / sqrt(2 * 3 * 300), 2 %.
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(3.0, rel=0.1)
    assert len(angles) >= 24 * 6
    assert all(track.body is None for track in replace(exact, bodies=False).read().tracks)
