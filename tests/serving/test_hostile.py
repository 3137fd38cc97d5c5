"""A thousand requests that nobody should send: each gets a status, and the server draws on as if there were none."""

import random
from typing import Any

import grpc
import numpy as np
import pytest
from google.protobuf.message import DecodeError

from sparsestreet.serving import wire
from tests.serving.street import as_sent, at, place, request_for, timed_views
from tests.serving.test_server import decoded, picture, rendered

COUNT = 1000
NUMBERS = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e-30, 1e30, 3.4e38, -7.5)
WHOLE = (0, 1, 7, 8193, 10**6, 2**31 - 1, 2**32 - 1)
"""Of sizes, enums and instants; no side between, which would take seconds to draw."""
STRINGS = ("", "*", "elsewhere", "../../etc/passwd", "str\x00eet", "\x1b[2J", "x" * 100_000, "sträße")
ALLOWED = {"OK", "INVALID_ARGUMENT", "NOT_FOUND", "UNIMPLEMENTED", "RESOURCE_EXHAUSTED"}


def fields_of(message: Any) -> list[tuple[Any, Any]]:
    """Every field of a message and of those that it holds, set or not."""
    found = []
    for field in message.DESCRIPTOR.fields:
        found.append((message, field))
        if field.message_type is not None:
            held = getattr(message, field.name)
            for one in held if field.is_repeated else [held]:
                found += fields_of(one)
    return found


def spoil(message: Any, dice: random.Random) -> None:
    """Give one field anywhere within a message a value that nobody means; those on top are as many as those below."""
    fields = fields_of(message)
    holder, field = dice.choice([one for one in fields if one[0] is message] if dice.random() < 0.5 else fields)
    if field.message_type is not None:
        kept = list(getattr(holder, field.name)) if field.is_repeated else []
        holder.ClearField(field.name)
        if kept:  # twice, or none
            getattr(holder, field.name).extend(kept * dice.choice((0, 2, 300)))
        return
    kind = {field.CPPTYPE_STRING: STRINGS, field.CPPTYPE_DOUBLE: NUMBERS, field.CPPTYPE_FLOAT: NUMBERS}
    value = dice.choice(kind.get(field.cpp_type, WHOLE))
    if field.cpp_type == field.CPPTYPE_STRING and field.type == field.TYPE_BYTES:
        value = value.encode()
    if field.cpp_type == field.CPPTYPE_BOOL:
        value = bool(value)
    if field.cpp_type == field.CPPTYPE_ENUM:
        value = min(value, 2**31 - 1)
    if field.is_repeated:
        getattr(holder, field.name).extend([value] * dice.choice((1, 1000)))
    else:
        setattr(holder, field.name, value)


def request(dice: random.Random) -> Any:
    made = request_for(dice.choice(timed_views()), image_format=dice.choice((1, 2)))
    place(made, "car", at(9.0, 0.2, 1.0))
    for _ in range(dice.randint(1, 4)):
        spoil(made, dice)
    return made


def hostile(dice: random.Random) -> tuple[str, bytes]:
    """The name of a call and the bytes of its message."""
    one = request(dice)
    way = dice.randrange(5)
    if way == 0:
        return dice.choice(list(wire.METHODS)), dice.randbytes(dice.choice((1, 10, 300)))
    data = bytearray(one.SerializeToString())
    if way == 1:
        return "render_rgb", bytes(data[: dice.randrange(len(data))])
    if way == 2:
        for _ in range(3):
            data[dice.randrange(len(data))] = dice.randrange(256)
        # No size between those of ``WHOLE``, by chance either.
        try:
            turned = wire.kind("RGBRenderRequest").FromString(bytes(data))
            turned.resolution_h, turned.resolution_w = 8, 8
            return "render_rgb", turned.SerializeToString()
        except DecodeError:
            return "render_rgb", bytes(data)
    if way == 3:
        batch = wire.kind("BatchRGBRenderRequest")()
        for number in range(dice.choice((0, 1, 3, 70))):
            batch.items.add(camera_name=dice.choice(("same", str(number))), request=one if number < 3 else None)
        return "batch_render_rgb", batch.SerializeToString()
    return "render_rgb", bytes(data)


def poses(message: Any) -> list[float]:
    """Every number of the poses of a request."""
    return [getattr(one, field.name) for one, field in fields_of(message) if one.DESCRIPTOR.name in ("Vec3", "Quat")]


@pytest.mark.lengthy
def test_a_thousand_hostile_requests_change_no_picture(client, caplog):
    views = timed_views()
    dice, statuses = random.Random(20), dict.fromkeys(ALLOWED | {"no message"}, 0)
    service = "/nre.grpc.protos.sensorsim.SensorsimService/"
    for number in range(COUNT):
        call, data = hostile(dice)
        try:
            means = wire.kind(wire.METHODS[call][0]).FromString(data)
        except DecodeError:
            means = None
        try:
            client.channel.unary_unary(service + call)(data, timeout=60)
            status, said = "OK", ""
        except grpc.RpcError as error:
            status, said = error.code().name, str(error.details())
        if means is None:
            assert status == "INVALID_ARGUMENT"
            assert "make messages of `serve --proto`" in said
            status = "no message"
        elif call == "render_rgb" and status == "OK":
            assert np.isfinite(poses(means)).all()
        assert status in statuses, f"request {number} for {call}: {status}, {said}"
        assert len(said) <= 1000
        statuses[status] += 1
        if number % 100 == 99:
            view = views[number // 100]
            assert np.array_equal(decoded(picture(client, view)), rendered(as_sent(view)))
    assert "a request failed" not in caplog.text
    # All ways were gone.
    assert min(statuses[name] for name in ("OK", "INVALID_ARGUMENT", "NOT_FOUND", "no message")) > 20, statuses
