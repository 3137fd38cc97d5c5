"""Health and reflection over a loopback: they need no thread of those that render, and nobody takes all of theirs."""

import threading
import time
from collections.abc import Iterator

import grpc
import pytest

from sparsestreet.scene.storage import load_scene
from sparsestreet.serving import standard, wire
from sparsestreet.serving.renderer import Scenes, named_runs
from sparsestreet.serving.server import start
from tests.serving.client import Client, theirs
from tests.serving.street import request_for, timed_views, write_run

SERVING, UNKNOWN = 1, 3


class Asker:
    """A server with one worker, and what asks for its health and its interface."""

    def __init__(self, folder) -> None:
        scenes = Scenes(named_runs([write_run(folder / "street")]), load_scene, memory=10**9)
        self.server, port = start(scenes, "127.0.0.1", 0, workers=1)
        self.client = Client(port)
        channel = self.client.channel
        self.ask = wire.kind("grpc.health.v1.HealthCheckRequest")
        said = wire.kind("grpc.health.v1.HealthCheckResponse").FromString
        self.check = channel.unary_unary("/grpc.health.v1.Health/Check", self.ask.SerializeToString, said)
        self.watch = channel.unary_stream("/grpc.health.v1.Health/Watch", self.ask.SerializeToString, said)
        self.reflect = [
            channel.stream_stream(
                f"/{package}.ServerReflection/ServerReflectionInfo",
                wire.kind(f"{package}.ServerReflectionRequest").SerializeToString,
                wire.kind(f"{package}.ServerReflectionResponse").FromString,
            )
            for package in wire.REFLECTIONS
        ]

    def services(self, number: int) -> list[str]:
        message = wire.kind(f"{wire.REFLECTIONS[number]}.ServerReflectionRequest")(list_services="")
        (answer,) = self.reflect[number](iter([message]), timeout=60)
        return [one.name for one in answer.list_services_response.service]


@pytest.fixture
def asker(tmp_path) -> Iterator[Asker]:
    made = Asker(tmp_path)
    yield made
    made.client.channel.close()
    made.server.stop(None).wait()


def test_they_answer_while_the_only_worker_renders(asker, monkeypatch):
    held, let_go = threading.Event(), threading.Event()

    def slow(served, view, edits):
        held.set()
        let_go.wait(30)
        raise MemoryError

    monkeypatch.setattr("sparsestreet.serving.server.picture", slow)
    picture = asker.client.calls["render_rgb"].future(theirs(request_for(timed_views()[0])), timeout=60)
    assert held.wait(30)
    assert asker.check(asker.ask(), timeout=5).status == SERVING
    assert next(asker.watch(asker.ask(), timeout=60)).status == SERVING
    assert asker.services(0) == asker.services(1)
    assert set(wire.SERVICES) < set(asker.services(0))
    let_go.set()
    assert picture.code() == grpc.StatusCode.RESOURCE_EXHAUSTED


def test_a_watch_says_how_a_service_is_and_stays_open(asker):
    watches = [asker.watch(asker.ask(service=wire.SERVICES[number % 2]), timeout=60) for number in range(40)]
    assert [next(one).status for one in watches] == [SERVING] * 40
    unknown = asker.watch(asker.ask(service="other"), timeout=60)
    assert next(unknown).status == UNKNOWN
    time.sleep(0.2)
    assert all(one.is_active() for one in (*watches, unknown))
    assert asker.client.get_version()
    asker.server.stop(0.1).wait()
    with pytest.raises(grpc.RpcError):
        next(unknown)


def test_watches_have_a_limit_and_give_their_places_back(tmp_path, monkeypatch):
    monkeypatch.setattr(standard, "MAX_WATCHERS", 2)
    asker = Asker(tmp_path)
    first, second = (asker.watch(asker.ask(), timeout=60) for _ in range(2))
    assert next(first).status == next(second).status == SERVING
    with pytest.raises(grpc.RpcError, match="2 calls watch already") as caught:
        next(asker.watch(asker.ask(), timeout=60))
    assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    first.cancel()
    deadline = time.monotonic() + 30
    while True:  # until the server has heard of it
        try:
            assert next(asker.watch(asker.ask(), timeout=60)).status == SERVING
            break
        except grpc.RpcError:
            assert time.monotonic() < deadline
            time.sleep(0.02)
    asker.client.channel.close()
    asker.server.stop(None).wait()


def test_who_sends_no_message_gives_the_thread_back(tmp_path, monkeypatch):
    """Twice as many as there are threads; those of a reflection also between two messages."""
    monkeypatch.setattr(standard, "WHOLE_MESSAGE", 0.3)
    asker, end = Asker(tmp_path), threading.Event()
    message = wire.kind(f"{wire.REFLECTIONS[0]}.ServerReflectionRequest")(list_services="")

    def one_and_silence():
        yield message
        end.wait(60)

    calls = [asker.reflect[0](one_and_silence(), timeout=60) for _ in range(2 * standard._THREADS)]
    assert all(next(call).list_services_response.service for call in calls)
    for call in calls:
        with pytest.raises(grpc.RpcError) as caught:
            next(call)
        assert caught.value.code() == grpc.StatusCode.CANCELLED
    assert asker.check(asker.ask(), timeout=10).status == SERVING
    empty = asker.client.channel.stream_stream("/grpc.health.v1.Health/Watch")
    with pytest.raises(grpc.RpcError, match="the call has no message: send one"):
        next(empty(iter(()), timeout=60))
    end.set()
    asker.client.channel.close()
    asker.server.stop(None).wait()


def test_the_client_of_grpcs_own_package_reads_the_interface(asker):
    database = pytest.importorskip(
        "grpc_reflection.v1alpha.proto_reflection_descriptor_database", reason="pip install grpcio-reflection"
    )
    from google.protobuf import descriptor_pool

    found = database.ProtoReflectionDescriptorDatabase(asker.client.channel)
    assert set(found.get_services()) == set(asker.services(1))
    service = descriptor_pool.DescriptorPool(found).FindServiceByName(wire.SERVICES[1])
    assert service.methods_by_name["render_rgb"].input_type.full_name == f"{wire.PACKAGE}.RGBRenderRequest"
    with pytest.raises(KeyError):
        found.FindFileContainingSymbol("nowhere")
