"""``bench serve``: requests that are wrong, objects that are placed where they are, and all of it once."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("grpc", reason="pip install 'sparsestreet[serve]'")

from sparsestreet.bench import serve, serve_client
from sparsestreet.bench.records import Provenance, RecordFile
from sparsestreet.bench.serve_fuzz import spoiled
from sparsestreet.records.provenance import this_machine, this_source
from sparsestreet.scene.edits import Edits
from sparsestreet.scene.storage import load_scene
from sparsestreet.serving.renderer import edits_of, picture, view_of
from sparsestreet.serving.scenes import RigOptions, Scenes, named_runs
from sparsestreet.serving.server import start
from tests.serving.street import as_sent, request_for, timed_views, write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "street")


@pytest.fixture(scope="module")
def client(run):
    server, port = start(Scenes(named_runs([run]), load_scene, memory=10**9, options=RigOptions()), "127.0.0.1", 0, 2)
    yield serve_client.Client(port, run)
    server.stop(None).wait()


def test_a_request_asks_for_what_the_view_sees(client):
    view = timed_views()[9]
    request = client.request(view)
    seen, expected = view_of(request, client.served.rig), as_sent(view)
    assert np.allclose(seen.camera.camera_from_world, expected.camera.camera_from_world, atol=1e-6)
    assert (seen.time, seen.camera_index) == (pytest.approx(view.time), view.camera_index)
    assert client.request(view, (96, 64)).resolution_w == 96
    answer = client.ask(client.request(view, image_format=serve_client.PNG))
    assert answer.image[:4] == b"\x89PNG"
    assert 0 < answer.own < answer.whole


def test_an_object_that_is_placed_where_it_is_changes_nothing(client):
    """But for float32 of its pose."""
    view = timed_views()[9]  # the car is there
    seen = view_of(client.request(view), client.served.rig)
    logged = picture(client.served, seen, Edits()).astype(int)
    box = client.box("car", view.time)
    assert box is not None
    for left, differs in ((0.0, False), (2.0, True)):
        request, place = client.request(view), box.copy()
        place[1, 3] += left
        serve_client.place(request, "car", place)
        shown = picture(client.served, seen, edits_of(request, client.served))
        assert (np.abs(shown - logged).max() > 1) == differs
    assert client.box("tram", 0.9) is None  # gone at time 0.5


def test_spoiled_messages_differ_and_repeat():
    whole = request_for(timed_views()[0])

    def some(seed: int) -> list[bytes]:
        rng = np.random.default_rng(seed)
        return [spoiled(copy.deepcopy(whole), rng).SerializeToString() for _ in range(50)]

    found = some(0)
    assert found == some(0)
    assert found != some(1)
    assert len(set(found)) > 45
    assert sum(one == whole.SerializeToString() for one in found) < 3


def test_wrong_requests_are_refused_and_none_is_an_error_of_the_server(client):
    record = serve.wrong_requests(client, 60)
    assert sum(record.statuses.values()) == record.requests == 60
    assert set(record.statuses) <= {"OK", "INVALID_ARGUMENT", "NOT_FOUND", "UNIMPLEMENTED"}
    assert record.statuses["INVALID_ARGUMENT"] > 10


def test_what_many_clients_take(client):
    record = serve.latency(client, (24, 16), clients=2, workers=2, count=6)
    assert (record.size, record.clients) == ((24, 16), 2)
    assert 0 < record.own <= record.p50 <= record.p99
    objects = serve.placed_objects(client, (24, 16), 3)
    assert objects is not None
    assert objects.objects == 2
    assert objects.without > 0


@pytest.mark.slow
def test_all_of_it_with_a_server_of_its_own(run, tmp_path):
    file = RecordFile(tmp_path / "serve.jsonl", Provenance("bench serve", 1, this_machine(), this_source()))
    said = []
    plan = replace(serve.QUICK, workers=(2, 1))
    assert serve.run_serve(run, plan, file, said.append)
    lines = [json.loads(line) for line in file.path.read_text().splitlines()]
    assert [line["kind"] for line in lines] == [
        *("latency", "latency", "objects", *["memory"] * 6, "wrong", "latency"),
    ]
    memory = [line["mb"] for line in lines if line["kind"] == "memory"]
    assert max(memory) < memory[0] + 50
    assert len(said) == len(lines)


@pytest.mark.slow
def test_memory_is_flat_and_wrong_requests_end_nothing(run):
    """As docs/serving.md says, with a scene of a few Gaussians: 5,000 requests, then 5,000 wrong ones."""
    with serve_client.server(run, workers=4) as (client, process):
        for number in range(500):
            client.ask(client.request(client.views[number % len(client.views)], serve.SMALL, serve_client.PNG))
        before = serve_client.resident_mb(process)
        for number in range(4500):
            client.ask(client.request(client.views[number % len(client.views)], serve.SMALL, serve_client.PNG))
        assert serve_client.resident_mb(process) < before + 15
        record = serve.wrong_requests(client, 5000, seed=1)
        assert not {"INTERNAL", "UNAVAILABLE", "UNKNOWN"} & set(record.statuses)
        assert client.ask(client.request(client.views[0])).image
