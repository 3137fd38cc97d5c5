"""Words of a command against a dataclass."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from sparsestreet.cli.commands.options import OptionError, parse_options, run_command


@dataclass(frozen=True)
class Wishes:
    scene: Path
    width: int = 640
    fps: float | None = None
    smooth: bool = False
    cameras: tuple[int, ...] | None = None
    nodes: tuple[str, ...] = ()
    frames: slice | None = None
    path: Literal["recorded", "shifted"] = "recorded"
    title: str = ""
    device: Literal["cpu", "cuda"] | None = None

    def __post_init__(self) -> None:
        if self.width > 9000:
            raise ValueError("width is more than a screen has")


@dataclass(frozen=True)
class Folders:
    folders: tuple[Path, ...]
    baseline: str | None = None


def test_every_kind_of_value_is_read():
    words = ["scene=a=b/run", "width=12", "fps=29.97", "smooth=true", "cameras=[0,2]", "nodes=background"]
    words += ["frames=3:40", "path=shifted", "title=two words", "device=cuda"]
    expected = Wishes(
        Path("a=b/run"), 12, 29.97, True, (0, 2), ("background",), slice(3, 40), "shifted", "two words", "cuda"
    )
    assert parse_options(words, Wishes) == expected


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["scene=r", "widht=5"], "no key 'widht'; did you mean 'width'?"),
        (["scene=r", "zz=5"], "no key 'zz'; there are scene, width"),
        (["width=5"], "scene=... is missing"),
        (["scene=r", "width=wide"], "width must be a whole number, got 'wide'"),
        (["scene=r", "fps=nan"], "fps must be a number, got 'nan'"),
        (["scene=r", "smooth=yes"], "smooth must be one of true, false, got 'yes'"),
        (["scene=r", "path=straight"], "path must be one of recorded, shifted, got 'straight'"),
        (["scene=r", "cameras=[0,left]"], "cameras must be a whole number, got 'left'"),
        (["scene=r", "cameras=[]"], "cameras has no value: write cameras=..., or leave it out"),
        (["scene=r", "frames=7"], "frames must be a range like 0:40, got '7'"),
        (["scene="], "scene has no value: write scene=..., or leave it out"),
        (["scene=r", "scene=q"], "scene is given twice: choose one"),
        (["run"], "'run' is no option: write key=value, with one of scene, width"),
        (["scene=r", "--width=5"], "'--width=5' is no option"),
        (["scene=r", "width=9001"], "width is more than a screen has"),
    ],
)
def test_a_slip_is_one_line_that_says_what_would_fit(words, said):
    with pytest.raises(OptionError) as caught:
        parse_options(words, Wishes)
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)


def test_words_without_a_key_go_to_the_field_that_takes_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("seed=1").mkdir()
    words = ["outputs", "sweep/method=3dgs", "seed=1", "baseline=plain"]
    wishes = parse_options(words, Folders, positional="folders")
    assert wishes == Folders((Path("outputs"), Path("sweep/method=3dgs"), Path("seed=1")), "plain")
    with pytest.raises(OptionError, match="did you mean 'baseline'"):
        parse_options(["outputs", "baselin=plain"], Folders, positional="folders")


@pytest.mark.parametrize(
    "words", [["a=b/run", "two words"], ["title=two words", "a=b/run"], ["two words", "scene=a=b/run"]]
)
def test_a_few_fields_take_a_word_each(words, tmp_path, monkeypatch):
    """In their order, those left out that have their key; a folder may have an equals sign in its name."""
    monkeypatch.chdir(tmp_path)
    Path("a=b/run").mkdir(parents=True)
    assert parse_options(words, Wishes, positional=("scene", "title")) == Wishes(Path("a=b/run"), title="two words")


def _fail(error: BaseException):
    def act(wishes: Wishes) -> None:
        raise error

    return act


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (FileNotFoundError("there is no scene"), 1, "sparsestreet film: there is no scene\n"),
        (ValueError("unknown instance"), 1, "sparsestreet film: unknown instance\n"),
        (ModuleNotFoundError("needs ffmpeg"), 1, "sparsestreet film: needs ffmpeg\n"),
        (KeyboardInterrupt(), 130, "sparsestreet film: stopped, nothing was written\n"),
    ],
)
def test_what_an_action_meets_is_one_line_and_a_status(error, status, said, capsys):
    assert run_command("film", "USAGE", ["scene=r"], Wishes, _fail(error)) == status
    assert capsys.readouterr().err == said


@pytest.mark.parametrize(("words", "status"), [(["--help"], 0), (["scene=r", "-h"], 0), ([], 2)])
def test_usage_is_shown_without_acting(words, status, capsys):
    assert run_command("film", "USAGE", words, Wishes, _fail(TypeError("acted"))) == status
    assert capsys.readouterr().out == "USAGE\n"
