"""The README's Python is what a new user copies: it runs as it stands."""

import re
from pathlib import Path
from typing import Any

import pytest

from sparsestreet.data.drivestudio import DriveStudioReader
from tests.conftest import unchecked

README = (Path(__file__).parents[2] / "README.md").read_text()


@pytest.mark.filterwarnings("ignore:The number of training batches")
def test_the_lines_of_python_train_a_street_and_render_it(tiny_street, tmp_path, monkeypatch):
    """On the street of the other tests, since tracing one takes seconds."""
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    assert sum(bool(line) for line in code.splitlines()) == 12
    (root,) = (word.partition("=")[2] for word in tiny_street if word.startswith("data.log.root="))
    code, streets = re.subn(r"StreetReader\(StreetSettings\(.*?\)\)", f"DriveStudioReader({root!r})", code)
    code, trainings = re.subn("max_steps=200", "max_steps=5", code)
    assert (streets, trainings) == (1, 1)
    names: dict[str, Any] = {"DriveStudioReader": DriveStudioReader}
    with unchecked():
        exec(code, names)
    assert names["image"].shape == (40, 64, 3)
    assert 0 < float(names["image"].mean()) < 1
    assert (tmp_path / "mine" / "scene.safetensors").is_file()
