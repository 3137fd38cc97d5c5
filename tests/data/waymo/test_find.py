"""Which version a folder holds, and how a segment is named."""

import pytest

from sparsestreet.data.problems import LogError
from sparsestreet.data.waymo import WaymoReader
from sparsestreet.data.waymo.reader import find_segments
from tests.data.waymo import records
from tests.data.waymo.drive import Drive

A, B = "1005_1_2_3", "2005_4_5_6"


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    root = tmp_path_factory.mktemp("two")
    for name in (A, B):
        records.write_drive(root / "training" / "part", Drive(num_frames=1), name)
    (root / "list.txt").write_text(f"segment-{B}_with_camera_labels\n{A}\n")
    return root


@pytest.mark.parametrize(
    ("scene", "name"),
    [
        (A, A),
        (f"segment-{B}_with_camera_labels.tfrecord", B),
        (0, B),
        (1, A),
        # Hydra and YAML take digits and underscores for a number.
        (2005456 * 10**20, None),
    ],
)
def test_by_name_or_by_place_in_a_list(scene, name, two):
    reader = WaymoReader(root=two, scene=scene, scenes=two / "list.txt")
    if name is None:
        with pytest.raises(ValueError, match=f"is not in {two}: data.log.scene must be one of {A}, {B}"):
            reader.read()
    else:
        assert reader.read().name == name


def test_a_name_that_was_taken_for_a_number(tmp_path):
    name = "10023947602400723454_1120_000_1140_000"
    records.write_drive(tmp_path, Drive(num_frames=1), name)
    assert WaymoReader(root=tmp_path, scene=int(name)).read().name == name


def test_a_choice_that_is_open(two):
    with pytest.raises(ValueError, match=f"must name one of the segments in {two}: {A}, {B}"):
        WaymoReader(root=two).read()
    with pytest.raises(ValueError, match=f"is a place in a list of segments: name the list .* {A}, {B}"):
        WaymoReader(root=two, scene=0).read()
    with pytest.raises(ValueError, match=f"is not within the 2 segments .* {A}, {B}"):
        WaymoReader(root=two, scene=2, scenes=two / "list.txt").read()
    with pytest.raises(ValueError, match=r"cameras \['SIDE_LEFT'\] must be different ones of the log's"):
        WaymoReader(root=two, scene=A, cameras=["SIDE_LEFT"]).read()


def test_a_folder_of_neither_or_both(tmp_path):
    with pytest.raises(LogError, match="there is no such folder"):
        find_segments(tmp_path / "absent")
    with pytest.raises(LogError, match="holds neither"):
        find_segments(tmp_path)
    for path in ("1.tfrecord", "vehicle_pose/1.parquet"):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).touch()
    with pytest.raises(LogError, match="1 segments of version 1"):
        find_segments(tmp_path)


def test_masks_of_a_user_replace_those_of_waymo(tmp_path):
    from PIL import Image

    records.write_drive(tmp_path / "log", Drive(num_frames=2))
    for frame in range(2):
        path = tmp_path / "masks" / "sky" / "FRONT" / f"{frame:03d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (32, 24), 255 * frame).save(path)
    log = WaymoReader(root=tmp_path / "log", masks=tmp_path / "masks").read()
    assert [None if one.sky is None else bool(one.sky.any()) for one in log.frames] == [False, None, True, None]
    # Frame 1 of FRONT has labels made by hand: they are not mixed with the user's.
    assert {one.vehicle for one in log.frames} == {None}
    assert "by hand" not in " ".join(log.notes)
    (tmp_path / "masks" / "sky" / "FRONT" / "001.png").unlink()
    (problem,) = WaymoReader(root=tmp_path / "log", masks=tmp_path / "masks").check()
    assert problem.path.name == "001.png"
