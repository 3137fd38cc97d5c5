"""The hash of a log: the same log in another place, and what changes it."""

import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from sparsestreet.data.drivestudio.annotations import role_of
from sparsestreet.data.kitti import KittiReader
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import Problem
from sparsestreet.data.reader import LogFiles, LogReader, hash_files
from sparsestreet.data.synthetic import StreetReader, StreetSettings

CONF = Path(__file__).parents[2] / "conf"
CLASSES = sorted(path.stem for path in (CONF / "data").glob("*.yaml"))


@dataclass(frozen=True)
class AnyFolder(LogReader):
    """Only its files are looked at."""

    root: Path

    @property
    def folder(self) -> Path:
        return self.root

    def check(self) -> list[Problem]:
        raise NotImplementedError

    def read(self) -> DrivingLog:
        raise NotImplementedError


@pytest.fixture
def log(tmp_path) -> Path:
    root = tmp_path / "log"
    (root / "images").mkdir(parents=True)
    (root / "poses.txt").write_text("1 0 0 0")
    (root / "images" / "0.bin").write_bytes(bytes(200_000))
    return root


def test_the_same_log_elsewhere_has_the_same_hash(log, tmp_path):
    before = AnyFolder(log).data_hash()
    assert len(before) == 12
    assert AnyFolder(shutil.copytree(log, tmp_path / "copy")).data_hash() == before


@pytest.mark.parametrize(
    ("place", "counts"), [(0, True), (4095, True), (4096, False), (195_903, False), (195_904, True), (199_999, True)]
)
def test_the_first_and_the_last_4_kb_of_what_was_recorded_count(log, place, counts):
    before = AnyFolder(log).data_hash()
    content = bytearray(200_000)
    content[place] = 1
    (log / "images" / "0.bin").write_bytes(content)
    assert (AnyFolder(log).data_hash() != before) == counts


@pytest.mark.parametrize("place", [0, 100_000, 199_999])
def test_of_what_describes_a_log_every_byte_counts(tmp_path, place):
    path = tmp_path / "boxes.json"
    path.write_bytes(bytes(200_000))
    before = hash_files(tmp_path, LogFiles(described=[path]))
    content = bytearray(200_000)
    content[place] = 1
    path.write_bytes(content)
    assert hash_files(tmp_path, LogFiles(described=[path])) != before


def test_the_order_of_files_does_not_count_and_their_absence_does(log):
    files = [log / "poses.txt", log / "images" / "0.bin", log / "boxes.json"]
    before = hash_files(log, LogFiles(recorded=files))
    assert hash_files(log, LogFiles(recorded=files[::-1])) == before
    (log / "boxes.json").touch()
    assert hash_files(log, LogFiles(recorded=files)) != before


@dataclass(frozen=True)
class OneFile(AnyFolder):
    def files(self) -> LogFiles:
        return LogFiles(recorded=[self.root / "images" / "0.bin"])


def test_what_a_reader_does_not_read_does_not_count(log):
    before = OneFile(log).data_hash(), AnyFolder(log).data_hash()
    (log / "another.log").write_text("of the same data set")
    assert OneFile(log).data_hash() == before[0]
    assert AnyFolder(log).data_hash() != before[1]


def test_names_and_sizes_count(log):
    before = AnyFolder(log).data_hash()
    (log / "images" / "0.bin").write_bytes(bytes(200_001))
    larger = AnyFolder(log).data_hash()
    (log / "images" / "0.bin").write_bytes(bytes(200_000))
    (log / "poses.txt").rename(log / "posen.txt")
    assert len({before, larger, AnyFolder(log).data_hash()}) == 3


def test_a_street_is_its_settings_wherever_it_lies(tmp_path):
    """It need not be there: what the settings say is what it shows."""
    street = StreetReader(StreetSettings(seed=3), root=tmp_path / "a")
    assert street.data_hash() == replace(street, root=tmp_path / "b").data_hash()
    assert street.data_hash() != StreetReader(StreetSettings(seed=4), root=tmp_path / "a").data_hash()
    assert street.data_hash() != StreetReader(StreetSettings(seed=3, num_frames=7)).data_hash()


@pytest.mark.parametrize("name", CLASSES)
def test_names_mean_what_the_configuration_of_their_data_set_says(name):
    classes = dict(OmegaConf.to_container(OmegaConf.load(CONF / "data" / f"{name}.yaml"))).get("classes")  # pyright: ignore
    if not isinstance(classes, dict):
        pytest.skip(f"data={name} has no classes of its own")
    for role, names in classes.items():
        assert {one: role_of(one) for one in names} == dict.fromkeys(names, role)


def test_the_identity_of_what_is_kept_changes_with_any_byte_and_setting(log):
    """Where runs find each other's answers (``kept``): a byte in the midst of an image counts, a cache's size not."""
    street = StreetReader(StreetSettings(seed=3), root=log)
    readers = [
        street, replace(street, lidar=False), replace(street, extent="first_pose"),
        replace(street, settings=StreetSettings(seed=4)), replace(street, lidar_ahead=[-2, 80]),
    ]  # fmt: skip
    found = [reader.identity() for reader in readers]
    assert len(set(found)) == len(readers)
    assert replace(street, cache_mb=7).identity() == found[0]
    content = bytearray(200_000)
    content[100_000] = 1
    (log / "images" / "0.bin").write_bytes(content)
    os.utime(log / "images" / "0.bin", ns=(0, 1))  # a clock of files may tick every few milliseconds
    changed = street.identity()
    assert changed not in found
    (log / "cameras.json").touch()
    assert street.identity() not in [*found, changed]
    assert AnyFolder(log).identity() is None  # of code that is not ours


def test_masks_beside_a_log_are_part_of_the_identity(log, tmp_path, monkeypatch):
    monkeypatch.setattr(KittiReader, "files", lambda self: LogFiles())
    reader = KittiReader(root=log, masks=tmp_path / "masks")
    before = reader.identity()
    path = tmp_path / "masks" / "ego" / "image_02" / "0000000000.png"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"white")
    drawn = reader.identity()
    os.utime(path, ns=(0, 1))
    assert len({before, drawn, reader.identity()}) == 3
