"""Scenes by name and by place, and the folder of tables."""

import json
import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from sparsestreet.data.nuscenes import NuScenesReader, tables
from sparsestreet.data.nuscenes.selection import find_instants
from sparsestreet.data.nuscenes.tables import LIDAR, DataFile, Row, SceneFiles, all_rows, rows_of_tokens, rows_where
from sparsestreet.data.problems import LogError
from tests.conftest import unchecked
from tests.data.nuscenes.written import Written, write_nuscenes
from tests.data.plan import Plan


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Written:
    """scene-0061, which has files, at place 1 of three. Nobody changes it."""
    written = write_nuscenes(tmp_path_factory.mktemp("nuscenes") / "drive", Plan(num_frames=2))
    (row,) = written.rows("scene")
    names = ("scene-0001", "scene-0061", "scene-0002")
    written.write(
        "scene", [{**row, "name": name, "token": row["token"] if name == row["name"] else name} for name in names]
    )
    return written


def test_by_name_or_by_place_whose_other_meaning_is_said(drive):
    said = "scene-0061 is read, at place 1 of v1.0-mini/scene.json"
    assert NuScenesReader(root=drive.root, scene="scene-0061").recording().notes[0] == said
    assert NuScenesReader(root=drive.root, scene=1).recording().notes[0] == (
        f"{said}, as data.log.scene=1 asks (DriveStudio counts so); for the scene whose name has this number say "
        "data.log.scene=scene-0001"
    )


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (None, "holds 3 scenes: name one, as data.log.scene=scene-0001; there are scene-0001, scene-0061, scene-0002"),
        ("scene-0103", "data.log.scene=scene-0103: no scene of .* has this name; there are scene-0001"),
        ("0061", "for the scene whose name has this number say data.log.scene=scene-0061"),
        (61, "place within 0 to 2 of scene.json; for the scene whose name .* data.log.scene=scene-0061"),
        (-1, "place within 0 to 2"),
        (True, "scene must be a name or a place"),
    ],
)
def test_a_scene_that_is_not_there_is_an_error_that_lists_those_that_are(drive, scene, said):
    with pytest.raises(ValueError, match=said):
        NuScenesReader(root=drive.root, scene=scene).recording()


def test_a_rate_that_is_none(drive):
    with unchecked(), pytest.raises(ValueError, match="rate must be one of keyframes, all, got '10hz'"):
        NuScenesReader(root=drive.root, rate="10hz")  # pyright: ignore[reportArgumentType]


def test_several_folders_of_tables(tmp_path):
    written = write_nuscenes(tmp_path / "drive", Plan(num_frames=2))
    shutil.copytree(written.root / "v1.0-mini", written.root / "v1.0-trainval")
    with pytest.raises(ValueError, match=r"tables of v1\.0-mini, v1\.0-trainval: say which, as data\.log\.version"):
        NuScenesReader(root=written.root).recording()
    assert NuScenesReader(root=written.root, version="v1.0-trainval").recording().name == "scene-0061"
    with pytest.raises(
        ValueError, match=r"data\.log\.version=v1\.0-test: .* holds no sample_data\.json; .* v1\.0-mini, v1\.0-trainval"
    ):
        NuScenesReader(root=written.root, version="v1.0-test").recording()


def test_a_folder_without_tables_says_which_one_is_meant(drive, tmp_path):
    with pytest.raises(LogError, match=r"holds no \*/sample_data\.json; name the folder that holds v1\.0-mini"):
        NuScenesReader(root=tmp_path).recording()
    with pytest.raises(LogError, match="name the one above"):
        NuScenesReader(root=drive.root / "v1.0-mini").recording()
    assert "no such folder" in NuScenesReader(root=tmp_path / "nowhere").check()[0].message


MS = 1_000_000
OFFSETS = {
    "CAM_FRONT": -35.5,
    "CAM_FRONT_LEFT": -43.1,
    "CAM_FRONT_RIGHT": -27.6,
    "CAM_BACK_LEFT": -0.5,
    "CAM_BACK_RIGHT": -20.1,
    "CAM_BACK": -10.4,
}
"""Milliseconds before the end of the turn of a genuine keyframe (nuscenes_one_keyframe)."""
TURNS = (0, 2, 4, 5, 7, 9)
"""Turns of the lidar in half a second at which all cameras fire: 12 images a second."""


def file(stamp: float, sample: int, keyframe: bool) -> DataFile:
    return DataFile(Row(Path("sample_data.json"), {}), Path(f"{stamp}"), sample, keyframe, round(stamp * MS))


def rig(drop: tuple[str, int] | None = None, jitter: float = 0.0) -> SceneFiles:
    """Two seconds. The lidar turns every 50 ms; a sample is every tenth turn."""
    noise = np.random.default_rng(0)
    turns = [turn + 10 * second for second in range(4) for turn in TURNS]
    files = {
        channel: tuple(
            file(50 * turn + offset + noise.uniform(-jitter, jitter), turn // 10, turn % 10 == 0)
            for place, turn in enumerate(turns)
            if (channel, place) != drop
        )
        for channel, offset in OFFSETS.items()
    }
    files[LIDAR] = tuple(file(50 * turn, min(-(-turn // 10), 3), turn % 10 == 0) for turn in range(40))
    samples = [Row(Path("sample.json"), {"token": f"{n}", "timestamp": 500_000 * n}) for n in range(4)]
    row = Row(Path("scene.json"), {"name": "scene-0061"})
    return SceneFiles(Path(), Path(), row, tuple(samples), files, {}, tuple(OFFSETS))


@pytest.mark.parametrize("jitter", [0.0, 8.0])
def test_the_six_images_of_a_turn_and_its_sweep_are_one_instant(jitter):
    """The next turn's front image may be 7 ms nearer to the image of the left back camera than its own."""
    scene = rig(jitter=jitter)
    instants = find_instants(scene, "all")
    assert (len(instants.stamps), len(instants.images), instants.without_instant) == (24, 144, 0)
    for channel in OFFSETS:
        assert [instants.images[n, channel] for n in range(24)] == list(scene.files[channel])
    turns = [turn + 10 * second for second in range(4) for turn in TURNS]
    assert [instants.sweeps[n].stamp for n in range(24)] == [50 * turn * MS for turn in turns]
    assert instants.of_samples == {0: 0, 1: 6, 2: 12, 3: 18}


def test_images_that_were_dropped():
    """One leaves a hole; without its front image an instant is gone, and its images are counted."""
    instants = find_instants(rig(drop=("CAM_BACK", 8)), "all")
    assert (8, "CAM_BACK") not in instants.images
    assert len(instants.images) == 143
    instants = find_instants(rig(drop=("CAM_FRONT", 8)), "all")
    assert (len(instants.stamps), len(instants.images), instants.without_instant) == (23, 138, 5)


def test_keyframes_have_the_files_of_their_samples():
    scene = rig()
    instants = find_instants(scene, "keyframes")
    assert instants.stamps == tuple(500 * MS * n for n in range(4))
    assert len(instants.images) == 24
    assert instants.images[2, "CAM_BACK"].stamp == round((1000 - 10.4) * MS)
    assert [instants.sweeps[n].stamp for n in range(4)] == list(instants.stamps)


def written(path: Path, count: int, **json_options) -> list[dict]:
    rows = [
        {
            "token": f"t{n}",
            "sample_token": f"s{n % 7}",
            "numbers": [[n, 0.5], [1e-9, -n]],
            "prev": "",
            "is_key_frame": True,
        }
        for n in range(count)
    ]
    path.write_text(json.dumps(rows, **json_options))
    return rows


@pytest.mark.parametrize("options", [{"indent": 0}, {}, {"indent": 4}, {"separators": (",", ":")}])
@pytest.mark.parametrize("chunk", [64, 1000, 1 << 22])
def test_rows_are_those_of_the_standard_parser(options, chunk, tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_CHUNK", chunk)
    rows = written(tmp_path / "t.json", 200, **options)
    found = rows_where(tmp_path / "t.json", "sample_token", {"s3", "s5"})
    assert [row.values for row in found] == [row for row in rows if row["sample_token"] in ("s3", "s5")]
    assert rows_of_tokens(tmp_path / "t.json", {"t17"})["t17"].values == rows[17]


def test_memory_is_that_of_the_rows_found(tmp_path, monkeypatch):
    """A table of 2.4 MB in pieces of 16 kB: what is held is a few pieces and one row."""
    monkeypatch.setattr(tables, "_CHUNK", 1 << 14)
    written(tmp_path / "t.json", 20_000, indent=0)
    tracemalloc.start()
    rows = rows_where(tmp_path / "t.json", "token", {"t19999"})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(rows) == 1
    assert peak < 200_000


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the table is cut short"),
        ("{}", "must be a JSON list"),
        ('[{"token": "a"}', "the table is cut short"),
        ('[{"token": "a"}, {"token": "b"', "the table is cut short"),
        ('[{"token": "a", "name": "}"}]', "the row with token 'a' is no JSON object"),
        ('[{"token": "a", "more": {"token": "b"}}]', "the row with token 'a' is no JSON object"),
        ('[{"token": "a", "token": "c"}]', "token 'a' is not in a row of its own"),
        ('[{"token": "a"}, {"token": "a"}]', "1 rows have the token of another row"),
        ('[{"token": "b"}]', "1 rows that other tables name are missing, the first is 'a'"),
        ('[{"token": "a", "n": ' + "[" * 100_000 + "}]", "is no JSON object"),
        ('[{"token": "a", "n": ' + "9" * 10_000 + "}]", "is no JSON object"),
        ("[" + " " * 2_000_000, "no row ends within 1048576 bytes"),
    ],
)
def test_what_is_no_table_of_flat_rows_is_refused(text, said, tmp_path):
    (tmp_path / "t.json").write_text(text)
    with pytest.raises(LogError, match=said) as caught:
        rows_of_tokens(tmp_path / "t.json", {"a"})
    assert caught.value.problems[0].path == tmp_path / "t.json"


def test_a_table_may_be_empty_and_one_that_is_parsed_at_once_has_a_limit(tmp_path):
    (tmp_path / "t.json").write_text(" [ \n ] \n")
    assert rows_where(tmp_path / "t.json", "token", {"t"}) == []
    assert all_rows(tmp_path / "t.json") == []
    with (tmp_path / "t.json").open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(LogError, match="the table has 1073741824 bytes, more than 67108864"):
        all_rows(tmp_path / "t.json")


def test_more_rows_than_a_scene_has_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_MAX_ROWS", 10)
    written(tmp_path / "t.json", 200)
    with pytest.raises(LogError, match="more than 10 rows belong to one scene"):
        rows_where(tmp_path / "t.json", "sample_token", {"s3"})
