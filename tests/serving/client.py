"""A client made of the messages that another package compiled from AlpaSim's files."""

from typing import Any

import grpc
import pytest

pb2 = pytest.importorskip(
    "carla_driver_interface._proto.sensorsim_pb2", reason="pip install carla-driver-interface==2.3.1"
)
common_pb2 = pytest.importorskip("carla_driver_interface._proto.common_pb2")

from google.protobuf import message_factory  # noqa: E402

LIMIT = 64 * 2**20
"""Of messages, as AlpaSim's runtime opens its channel to a renderer."""


class Client:
    """Each call of the service by its name."""

    def __init__(self, port: int, service: str = "nre.grpc.protos.sensorsim.SensorsimService") -> None:
        limits = [("grpc.max_receive_message_length", LIMIT), ("grpc.max_send_message_length", LIMIT)]
        self.channel = grpc.insecure_channel(f"127.0.0.1:{port}", options=limits)
        self.calls = {
            method.name: self.channel.unary_unary(
                f"/{service}/{method.name}",
                request_serializer=_bytes,
                response_deserializer=message_factory.GetMessageClass(method.output_type).FromString,
            )
            for method in pb2.DESCRIPTOR.services_by_name["SensorsimService"].methods
        }

    def __getattr__(self, name: str) -> Any:
        return lambda request=None, **options: self.calls[name](
            common_pb2.Empty() if request is None else request, timeout=60, wait_for_ready=True, **options
        )


def _bytes(message: Any) -> bytes:
    return message.SerializeToString()


def theirs(message: Any) -> Any:
    """A message of ours as one of theirs, by its bytes."""
    return getattr(pb2, message.DESCRIPTOR.name).FromString(message.SerializeToString())
