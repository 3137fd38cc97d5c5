"""A server of one small street, and a client of it."""

from collections.abc import Iterator

import pytest

from sparsestreet.scene.storage import load_scene
from sparsestreet.serving.renderer import Scenes, named_runs
from sparsestreet.serving.server import start
from tests.serving.client import Client
from tests.serving.street import write_run


@pytest.fixture(scope="module")
def client(tmp_path_factory) -> Iterator[Client]:
    runs = named_runs([write_run(tmp_path_factory.mktemp("runs") / "street")])
    server, port = start(Scenes(runs, load_scene, memory=10**9), "127.0.0.1", 0, workers=2)
    made = Client(port)
    yield made
    made.channel.close()
    server.stop(None).wait()
