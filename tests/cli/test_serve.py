"""``sparsestreet serve`` and the artifact of ``export``."""

import signal
import subprocess
import sys
import zipfile
from dataclasses import fields

import pytest

from sparsestreet.cli.commands.export import export
from sparsestreet.cli.commands.serve import USAGE, ServeRequest, serve
from tests.serving.street import write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "street")


@pytest.mark.lengthy
def test_a_server_serves_until_it_is_told_to_end(run):
    from tests.serving.client import Client, theirs
    from tests.serving.street import request_for, timed_views

    words = [str(run), "port=0", "device=cpu", "names=a,b,c,d", "mount=1.0,0,1.5"]
    command = [sys.executable, "-c", "from sparsestreet.cli import main; main()", "serve", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == "street: cameras a, b, c, d\n"
        said = server.stdout.readline()
        assert said.startswith("serving 1 scene at 127.0.0.1:")
        client = Client(int(said.partition("127.0.0.1:")[2].partition(";")[0]))
        assert client.render_rgb(theirs(request_for(timed_views()[0]))).image_bytes
        client.channel.close()
        server.send_signal(signal.SIGTERM)
        assert server.wait(30) == 0
        assert "requests under way have 5 s" in server.stdout.read()


def test_the_help_names_every_option():
    for field in fields(ServeRequest):
        assert f"\n  {field.name} " in USAGE


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["port=70000"], "port lies in 0 to 65535"),
        (["workers=0"], "must be above 0"),
        (["mount=1,2"], "mount is three numbers"),
    ],
)
def test_wrong_usage(run, capsys, words, said):
    assert serve([str(run), *words]) == 2
    assert said in capsys.readouterr().err


def test_what_is_no_run_is_said_before_anything_is_served(tmp_path, capsys):
    assert serve([str(tmp_path)]) == 1
    assert "give the folder of a finished run" in capsys.readouterr().err


def test_without_grpc_a_sentence_names_the_extra(run, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "sparsestreet.serving.server", raising=False)
    monkeypatch.setitem(sys.modules, "grpc", None)
    assert serve([str(run)]) == 1
    assert "pip install 'sparsestreet[serve]'" in capsys.readouterr().err


def test_the_artifact_of_a_run(run, tmp_path, capsys):
    assert export([str(run), str(tmp_path / "street.usdz"), "car=4,1.8,1.5"]) == 0
    assert "scene 'street' with 5 poses, 4 cameras, 0 objects" in capsys.readouterr().out
    with zipfile.ZipFile(tmp_path / "street.usdz") as found:
        assert len(found.namelist()) == 3
    assert export([str(run), str(tmp_path / "street.ply"), "car=4,1.8,1.5"]) == 2
    assert "car is no option of a .ply" in capsys.readouterr().err
