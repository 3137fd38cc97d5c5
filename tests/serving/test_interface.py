"""The interface as tools read it, against messages that others compiled from AlpaSim's files."""

import re

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool

from sparsestreet.serving import wire
from sparsestreet.serving.interface import proto_text, reflected
from tests.serving.test_wire import FILES, entries_by, entries_of, file_facts, pb2

REFLECTION = "grpc.reflection.v1"


def asked(package: str = REFLECTION, **fields):
    request = wire.kind(f"{package}.ServerReflectionRequest")(host="here")
    for name, value in fields.items():
        getattr(request, name).CopyFrom(value) if name == "file_containing_extension" else setattr(request, name, value)
    return reflected(request)


def test_the_text_has_each_field_and_call_of_the_independent_package():
    text = proto_text()
    assert entries_of(text) == set().union(*(entries_by(file_facts(file)) for file in FILES.values()))
    service = pb2.DESCRIPTOR.services_by_name["SensorsimService"]
    calls = {(one.name, one.input_type.name, one.output_type.name) for one in service.methods}
    assert set(re.findall(r"rpc (\w+)\((\w+)\) returns \((\w+)\);", text)) == calls
    # What is repeated, and what is one of several: the entries above say neither.
    repeated = {
        field.name for file in FILES.values() for kind in file.message_types_by_name.values() for field in every(kind)
    }
    assert set(re.findall(r"repeated [\w.]+ (\w+) =", text)) == repeated
    assert re.search(r"oneof camera_param \{\n(\s+\w+ \w+ = [234];\n){3}", text)


def every(kind):
    """The repeated fields of a message and of those within it."""
    yield from (field for field in kind.fields if field.is_repeated)
    for inner in kind.nested_types:
        yield from every(inner)


def test_a_compiler_reads_the_text_as_the_same_messages(tmp_path):
    protoc = pytest.importorskip("grpc_tools.protoc", reason="pip install grpcio-tools")
    (tmp_path / "sensorsim.proto").write_text(proto_text())
    words = ["protoc", f"-I{tmp_path}", f"--descriptor_set_out={tmp_path / 'out'}", "sensorsim.proto"]
    assert protoc.main(words) == 0
    (file,) = descriptor_pb2.FileDescriptorSet.FromString((tmp_path / "out").read_bytes()).file
    made = descriptor_pool.DescriptorPool()
    made.Add(file)
    compiled = file_facts(made.FindFileByName("sensorsim.proto"))
    theirs = {}
    for package, one in FILES.items():
        for name, fact in file_facts(one).items():
            moved = tuple(within(part) for part in fact) if isinstance(fact, tuple) else fact
            theirs[within(name)] = moved
        assert package in ("common", wire.PACKAGE)
    assert compiled == theirs


def within(name):
    """A name of ``common`` in the one package of the text."""
    return f"{wire.PACKAGE}.{name.removeprefix('common.')}" if str(name).startswith("common.") else name


@pytest.mark.parametrize("package", wire.REFLECTIONS)
def test_reflection_gives_all_that_a_symbol_needs(package):
    listed = [one.name for one in asked(package, list_services="").list_services_response.service]
    assert set(wire.SERVICES) | {"grpc.health.v1.Health", f"{package}.ServerReflection"} <= set(listed)
    for name in listed:
        answer = asked(package, file_containing_symbol=name)
        assert answer.valid_host == "here"
        assert answer.original_request.file_containing_symbol == name
        made = descriptor_pool.DescriptorPool()
        files = list(answer.file_descriptor_response.file_descriptor_proto)
        assert len(files) == len(set(files))
        for file in files:  # in an order in which each finds what it needs
            made.AddSerializedFile(file)
        service = made.FindServiceByName(name)
        if name in wire.SERVICES:
            theirs = pb2.DESCRIPTOR.services_by_name["SensorsimService"]
            calls = [
                {(one.name, one.input_type.full_name, one.output_type.full_name) for one in each.methods}
                for each in (service, theirs)
            ]
            assert calls[0] == calls[1]
            for own, file in FILES.items():
                assert file_facts(made.FindFileByName(f"{own}.proto")) == file_facts(file)
    (file,) = asked(package, file_by_filename="common.proto").file_descriptor_response.file_descriptor_proto
    assert descriptor_pb2.FileDescriptorProto.FromString(file).package == "common"


def test_standard_services_stream_as_grpc_says():
    """Watch has many answers, reflection also many messages."""
    ways = {
        f"{file.package}.{service.name}/{method.name}": (method.client_streaming, method.server_streaming)
        for file in wire.files()
        for service in file.service
        for method in service.method
    }
    assert ways["grpc.health.v1.Health/Watch"] == (False, True)
    assert ways["grpc.health.v1.Health/Check"] == (False, False)
    assert ways["grpc.reflection.v1.ServerReflection/ServerReflectionInfo"] == (True, True)
    assert ways[f"{wire.SERVICES[1]}/render_rgb"] == (False, False)


def test_what_is_not_there_is_an_error_within_the_answer():
    extension = wire.kind(f"{REFLECTION}.ExtensionRequest")(containing_type="common.Pose", extension_number=9)
    for answer in (
        asked(file_containing_symbol="common.Nothing"),
        asked(file_by_filename="../../etc/passwd"),
        asked(all_extension_numbers_of_type="x" * 10**5),
        asked(file_containing_extension=extension),
    ):
        assert answer.error_response.error_code == 5
        assert "list_services tells what there is" in answer.error_response.error_message
        assert len(answer.error_response.error_message) < 300
    assert asked().error_response.error_code == 3
    assert asked(all_extension_numbers_of_type="common.Pose").all_extension_numbers_response.base_type_name
