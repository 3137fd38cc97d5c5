"""The gRPC server: calls by their names, statuses for what goes wrong, one rendering at a time on a device.

Requests take turns at rendering, in the order in which they came, and encode outside of them: a device renders while
the threads of other requests encode. No request ends the server.
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar

import grpc

import sparsestreet
from sparsestreet.demand import as_demand
from sparsestreet.listening import address, check_address
from sparsestreet.records.run import this_source
from sparsestreet.serving import wire
from sparsestreet.serving.cameras import NotServedError, Turns, camera_spec, pose_message
from sparsestreet.serving.lidar import lidar_message, sweep, turn_of
from sparsestreet.serving.remarks import Remarks
from sparsestreet.serving.renderer import (
    Picture,
    Scenes,
    ServedScene,
    UnknownSceneError,
    edits_of,
    encoded,
    picture,
    view_of,
)
from sparsestreet.serving.standard import handler, only_message, refuse, standard_handlers

log = logging.getLogger(__name__)

MAX_MESSAGE = 64 * 2**20
"""Bytes: that of AlpaSim's channel to its renderer."""
MAX_WAITING = 256
"""Requests at the same time; further ones get RESOURCE_EXHAUSTED."""
_MAX_CAMERAS = 64
"""Of a batch."""
_CODES = {
    UnknownSceneError: grpc.StatusCode.NOT_FOUND,
    NotServedError: grpc.StatusCode.UNIMPLEMENTED,
    ValueError: grpc.StatusCode.INVALID_ARGUMENT,
    OSError: grpc.StatusCode.FAILED_PRECONDITION,
}
"""The first that an error is one of. Where memory does not do (``as_demand``), it is RESOURCE_EXHAUSTED; what is none
of these is INTERNAL, and the server's log has its trace."""


Drawn = TypeVar("Drawn")
"""What a device renders: a picture, or returns."""


class GoneError(Exception):
    """Nobody waits for the answer any more: the request was canceled, or its deadline passed."""


class Sensorsim:
    """The calls of SensorsimService; each takes a message and gRPC's context, and returns a message."""

    def __init__(self, scenes: Scenes, encoders: int = 4) -> None:
        """``encoders``: threads that encode the pictures of batches."""
        self.scenes = scenes
        self._device = Turns()
        self._remarks = Remarks()
        self._encoders = ThreadPoolExecutor(encoders, "encode")

    def render_rgb(self, request: Any, context: grpc.ServicerContext) -> Any:
        image, spent = self._rendered(request, context)
        started = time.perf_counter()
        data = encoded(image, request.image_format, request.image_quality)
        spent["encode-ms"] = 1000 * (time.perf_counter() - started)
        _say_spent(context, spent)
        return wire.kind("RGBRenderReturn")(image_bytes=data)

    def batch_render_rgb(self, request: Any, context: grpc.ServicerContext) -> Any:
        """Each camera once; one that fails says why and leaves the others as they are."""
        names = [item.camera_name for item in request.items]
        if len(set(names)) < len(names) or len(names) > _MAX_CAMERAS:
            raise ValueError(f"a batch has at most {_MAX_CAMERAS} cameras, each once, got {names[: _MAX_CAMERAS + 1]}")
        started: list[tuple[str, Future[bytes] | Exception]] = []
        for item in request.items:
            one = item.request
            try:
                image, _ = self._rendered(one, context)
                data = self._encoders.submit(encoded, image, one.image_format, one.image_quality)
                started.append((item.camera_name, data))
            except GoneError:
                raise
            except Exception as error:
                started.append((item.camera_name, error))
        answer = wire.kind("BatchRGBRenderReturn")()
        for name, outcome in started:
            failed = outcome.exception() if isinstance(outcome, Future) else outcome
            item = answer.items.add(camera_name=name, success=failed is None)
            if isinstance(outcome, Future) and failed is None:
                item.result.image_bytes = outcome.result()
            elif failed is not None:
                item.error_message = _status_of(failed)[1]
        return answer

    def get_version(self, request: Any, context: grpc.ServicerContext) -> Any:
        major, minor, patch = wire.API_VERSION
        version = wire.kind("common.VersionId")(version_id=f"sparsestreet {sparsestreet.__version__}")
        version.git_hash = this_source().commit or ""
        version.grpc_api_version.major, version.grpc_api_version.minor, version.grpc_api_version.patch = (
            major,
            minor,
            patch,
        )
        return version

    def get_available_scenes(self, request: Any, context: grpc.ServicerContext) -> Any:
        return wire.kind("common.AvailableScenesReturn")(scene_ids=self.scenes.names)

    def get_loaded_scenes(self, request: Any, context: grpc.ServicerContext) -> Any:
        answer = wire.kind("LoadedScenesReturn")(loaded_instance_capacity=len(self.scenes.names))
        for name in self.scenes.opened:
            answer.scenes.add(scene_id=name, loaded_instance_count=1, reusable_instance_count=1)
        return answer

    def get_available_cameras(self, request: Any, context: grpc.ServicerContext) -> Any:
        answer = wire.kind("AvailableCamerasReturn")()
        for one in self.scenes.rig(request.scene_id).cameras:
            spec, mount = camera_spec(one.name, one.camera), pose_message(one.rig_from_camera)
            answer.available_cameras.add(intrinsics=spec, rig_to_camera=mount, logical_id=one.name)
        return answer

    def get_available_trajectories(self, request: Any, context: grpc.ServicerContext) -> Any:
        """The recorded drive of the vehicle."""
        rig = self.scenes.rig(request.scene_id)
        answer = wire.kind("AvailableTrajectoriesReturn")()
        trajectory = answer.available_trajectories.add().trajectory
        for instant, pose in zip(rig.times, rig.poses, strict=True):
            trajectory.poses.add(pose=pose_message(pose), timestamp_us=rig.clock.microseconds(instant))
        return answer

    def get_available_ego_masks(self, request: Any, context: grpc.ServicerContext) -> Any:
        """None: the vehicle is no part of a scene."""
        return wire.kind("AvailableEgoMasksReturn")()

    def render_lidar(self, request: Any, context: grpc.ServicerContext) -> Any:
        served = self.scenes.get(request.scene_id)
        self._remarks.on_names(served, request)
        turn, edits = turn_of(request, served.rig), edits_of(request, served)
        self._remarks.on_heights(served, turn.time, edits)
        found, spent = self._in_turn(lambda: sweep(served, turn, edits), context)
        _say_spent(context, spent)
        return lidar_message(found)

    def render_aggregated(self, request: Any, context: grpc.ServicerContext) -> Any:
        raise NotServedError("this server aggregates nothing: call batch_render_rgb and render_lidar")

    def _rendered(self, request: Any, context: grpc.ServicerContext) -> tuple[Picture, dict[str, float]]:
        """Return the picture and what it took, milliseconds, as the answer's trailing metadata call it."""
        served: ServedScene = self.scenes.get(request.scene_id)
        self._remarks.on_names(served, request)
        view, edits = view_of(request, served.rig), edits_of(request, served)
        self._remarks.on_camera(served, view)
        self._remarks.on_heights(served, view.time, edits)
        return self._in_turn(lambda: picture(served, view, edits), context)

    def _in_turn(self, draw: Callable[[], Drawn], context: grpc.ServicerContext) -> tuple[Drawn, dict[str, float]]:
        asked = time.perf_counter()
        with self._device.turn(partial(_check_wanted, context)):
            started = time.perf_counter()
            drawn = draw()
        return drawn, {"wait-ms": 1000 * (started - asked), "render-ms": 1000 * (time.perf_counter() - started)}


def start(scenes: Scenes, host: str, port: int, workers: int) -> tuple[grpc.Server, int]:
    """A server that answers, and its port; port 0 takes a free one.

    Args:
        scenes: what is served.
        host: the address that it listens on; there is no authentication, so 127.0.0.1 unless the network is yours.
        port: where.
        workers: requests that are worked on at the same time, and threads that encode batches.

    Raises OSError where nobody can listen there.
    """
    check_address(host, port)
    service = Sensorsim(scenes, encoders=workers)
    size = [(f"grpc.max_{way}_message_length", MAX_MESSAGE) for way in ("send", "receive")]
    # Two servers on one port would share its requests.
    server = grpc.server(
        ThreadPoolExecutor(workers, "serve"),
        options=[*size, ("grpc.so_reuseport", 0)],
        maximum_concurrent_rpcs=MAX_WAITING,
    )
    server.add_generic_rpc_handlers((*_handlers(service), *standard_handlers()))
    try:
        bound = server.add_insecure_port(address(host, port))
    except RuntimeError as error:
        raise OSError(f"nobody can listen on {address(host, port)}: {error}") from error
    server.start()
    return server, bound


Call = Callable[[Any, grpc.ServicerContext], Any]


def _handlers(service: Sensorsim) -> list[grpc.GenericRpcHandler]:
    calls = {
        name: handler(grpc.stream_unary_rpc_method_handler, partial(_awaited, getattr(service, name)), *kinds)
        for name, kinds in wire.METHODS.items()
    }
    return [grpc.method_handlers_generic_handler(name, calls) for name in wire.SERVICES]


def _awaited(call: Call, requests: Iterator[Any], context: grpc.ServicerContext) -> Any:
    return _answered(call, only_message(requests, context), context)


def _answered(call: Call, request: Any, context: grpc.ServicerContext) -> Any:
    """The answer of a call; whatever goes wrong becomes a status."""
    try:
        return call(request, context)
    except GoneError:
        refuse(context, grpc.StatusCode.CANCELLED, "nobody waits for the answer any more")
    except Exception as error:
        refuse(context, *_status_of(error))


def _status_of(error: BaseException) -> tuple[grpc.StatusCode, str]:
    """The status of an error and what is said of it; the log has the trace of one that nobody expects."""
    for kind, code in _CODES.items():
        if isinstance(error, kind):
            return code, str(error)
    demand = as_demand(error)
    if demand is not None:
        return grpc.StatusCode.RESOURCE_EXHAUSTED, str(demand)
    log.error("a request failed", exc_info=error)
    return grpc.StatusCode.INTERNAL, f"{type(error).__name__}: {error}"


def _say_spent(context: grpc.ServicerContext, spent: Mapping[str, float]) -> None:
    context.set_trailing_metadata(tuple((name, f"{value:.3f}") for name, value in spent.items()))


def _check_wanted(context: grpc.ServicerContext) -> None:
    if not context.is_active():
        raise GoneError
