"""gRPC's standard services, health and reflection: they answer on threads of their own, while pictures are rendered."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn

import grpc
from google.protobuf.message import DecodeError

from sparsestreet.serving import wire
from sparsestreet.serving.interface import reflected

WHOLE_MESSAGE = 60.0
"""Seconds within which the next message of a call must have come; a call without one holds a place of all."""
MAX_WATCHERS = 256
"""Calls that watch how the server is, at the same time; they stay open and hold no thread."""
_THREADS = 8
"""A tool holds one for as long as it asks what the server has."""
_LONGEST_DETAILS = 1000
"""Characters: gRPC refuses statuses of some kilobytes, and names in requests may be long."""


@dataclass(frozen=True)
class _Beside:
    """A call on threads of its own, marked as grpcio's own health service marks its calls."""

    call: Callable[..., Any]
    experimental_thread_pool: ThreadPoolExecutor
    experimental_non_blocking: bool = False
    """Whether the call stays open after it returned: one that waits would hold a thread."""

    def __call__(self, *told: Any, **named: Any) -> Any:
        return self.call(*told, **named)


def standard_handlers() -> list[grpc.GenericRpcHandler]:
    """Return the handlers of ``grpc.health.v1.Health``, and of both versions of ``ServerReflection``."""
    threads = ThreadPoolExecutor(_THREADS, "standard")
    watch = _Beside(partial(_watch, threading.Semaphore(MAX_WATCHERS)), threads, experimental_non_blocking=True)
    health = {
        "Check": (grpc.stream_unary_rpc_method_handler, _Beside(_check, threads)),
        "Watch": (grpc.stream_stream_rpc_method_handler, watch),
    }
    reflection = {"ServerReflectionInfo": (grpc.stream_stream_rpc_method_handler, _Beside(_reflect, threads))}
    kinds = ("HealthCheckRequest", "HealthCheckResponse")
    made = [_service("grpc.health.v1", "Health", health, *kinds)]
    kinds = ("ServerReflectionRequest", "ServerReflectionResponse")
    return [*made, *(_service(package, "ServerReflection", reflection, *kinds) for package in wire.REFLECTIONS)]


def _service(package: str, name: str, calls: dict[str, Any], request: str, answer: str) -> grpc.GenericRpcHandler:
    made = {call: handler(make, behavior, f"{package}.{request}", f"{package}.{answer}")
            for call, (make, behavior) in calls.items()}  # fmt: skip
    return grpc.method_handlers_generic_handler(f"{package}.{name}", made)


def handler(make: Callable[..., grpc.RpcMethodHandler], call: Any, request: str, answer: str) -> grpc.RpcMethodHandler:
    """Return the handler of a call; all take a stream of messages, so that the wait for each has an end."""
    return make(
        call,
        request_deserializer=partial(_read, wire.kind(request)),
        response_serializer=wire.kind(answer).SerializeToString,
    )


def _read(kind: Any, data: bytes) -> Any:
    """The message, or the error, which ``next_message`` answers: gRPC would log a trace for each."""
    try:
        return kind.FromString(data)
    except DecodeError as error:
        return error


def next_message(requests: Iterator[Any], context: grpc.ServicerContext) -> Any:
    """Return the next message of a call, None behind its last; a sender that keeps all waiting ends the call."""
    late = threading.Timer(WHOLE_MESSAGE, context.cancel)
    late.start()
    try:
        request = next(requests, None)
    finally:
        late.cancel()
    if isinstance(request, DecodeError):
        refuse(context, grpc.StatusCode.INVALID_ARGUMENT, f"{request}: make messages of `serve --proto`")
    return request


def only_message(requests: Iterator[Any], context: grpc.ServicerContext) -> Any:
    """Return the one message of a call."""
    request = next_message(requests, context)
    if request is None:
        refuse(context, grpc.StatusCode.INVALID_ARGUMENT, "the call has no message: send one")
    return request


def refuse(context: grpc.ServicerContext, code: grpc.StatusCode, said: str) -> NoReturn:
    """End a call with a status."""
    context.abort(code, said[:_LONGEST_DETAILS])
    raise AssertionError("abort raises")


def _is_served(request: Any) -> bool:
    return request.service in ("", *wire.SERVICES)


def _check(requests: Iterator[Any], context: grpc.ServicerContext) -> Any:
    request = only_message(requests, context)
    if not _is_served(request):
        refuse(context, grpc.StatusCode.NOT_FOUND, f"there is no service {request.service!r}")
    return wire.kind("grpc.health.v1.HealthCheckResponse")(status="SERVING")


def _watch(
    places: threading.Semaphore,
    requests: Iterator[Any],
    context: grpc.ServicerContext,
    send_response_callback: Callable[[Any], None],
) -> None:
    """Say once how a service is; the call stays open until one side goes, for nothing changes before."""
    request = only_message(requests, context)
    if not places.acquire(blocking=False):
        said = f"{MAX_WATCHERS} calls watch already: end some, or call Check"
        refuse(context, grpc.StatusCode.RESOURCE_EXHAUSTED, said)
    if not context.add_callback(places.release):
        places.release()  # it went meanwhile
        return
    status = "SERVING" if _is_served(request) else "SERVICE_UNKNOWN"
    send_response_callback(wire.kind("grpc.health.v1.HealthCheckResponse")(status=status))


def _reflect(requests: Iterator[Any], context: grpc.ServicerContext) -> Iterator[Any]:
    while (request := next_message(requests, context)) is not None:
        yield reflected(request)
