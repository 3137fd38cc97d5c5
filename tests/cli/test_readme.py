"""The README's Python is what a new user copies: it runs as it stands."""

import re
from pathlib import Path

import pytest

from sparsestreet.data.drivestudio import DriveStudioReader
from tests.conftest import unchecked

README = (Path(__file__).parents[2] / "README.md").read_text()


def test_the_lines_of_python_render_a_run(finished, capsys):
    """A new process opens a scene in test_train.py."""
    code, _ = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    code = code.replace('"RUN"', repr(str(finished)))
    with unchecked():
        exec(code, {})
    said = capsys.readouterr().out
    assert "[192, 320, 3]" in said
    assert "'background'" in said


@pytest.mark.filterwarnings("ignore:The number of training batches")
def test_the_lines_of_python_train_a_street(tiny_street, tmp_path, monkeypatch, capsys):
    """On the street of the other tests, since tracing one takes seconds."""
    monkeypatch.chdir(tmp_path)
    _, code = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    (root,) = (word.partition("=")[2] for word in tiny_street if word.startswith("data.log.root="))
    code, streets = re.subn(r"StreetReader\(StreetSettings\(.*?\)\)", f"DriveStudioReader({root!r})", code)
    code, trainings = re.subn("max_steps=200", "max_steps=5", code)
    assert (streets, trainings) == (1, 1)
    with unchecked():
        exec(code, {"DriveStudioReader": DriveStudioReader})
    psnr, gaussians = capsys.readouterr().out.splitlines()[-1].split(maxsplit=1)
    assert 5 < float(psnr) < 40
    assert gaussians.startswith("{'background': 5000, 'rigid': ")
    assert (tmp_path / "outputs" / "mine" / "scene.safetensors").is_file()
