"""The hash of a log: the same log in another place, and what changes it."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import Problem
from sparsestreet.data.reader import LogReader
from sparsestreet.data.synthetic import StreetReader, StreetSettings


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


@pytest.mark.parametrize("place", [0, 65535, 200_000 - 65536, 199_999])
def test_the_first_and_the_last_64_kb_count(log, place):
    before = AnyFolder(log).data_hash()
    content = bytearray(200_000)
    content[place] = 1
    (log / "images" / "0.bin").write_bytes(content)
    assert AnyFolder(log).data_hash() != before


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
