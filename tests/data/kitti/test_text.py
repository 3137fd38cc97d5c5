"""Stamps by line, in nanoseconds."""

import pytest

from sparsestreet.data.kitti.files import read_stamps


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        # GNU date: date -u -d "2011-09-26 13:04:32" +%s
        ("2011-09-26 13:04:32.345323776", 1_317_042_272_345_323_776),
        ("2011-09-26 13:04:32.3453", 1_317_042_272_345_300_000),
        ("2011-09-26 13:04:32", 1_317_042_272_000_000_000),
        ("2012-02-29 23:59:59.000000001", 1_330_559_999_000_000_001),
    ],
)
def test_a_line_is_the_stamp_of_its_frame(tmp_path, text, stamp):
    path = tmp_path / "timestamps.txt"
    path.write_text(f"{text}\n\n{text}\r\n")
    assert read_stamps(path) == [stamp, None, stamp]
