"""The interface as other tools read it: a ``.proto``, and the answers of gRPC's server reflection."""

from typing import Any

import grpc
from google.protobuf import descriptor_pb2

from sparsestreet.serving import wire

MAX_SAID = 200
"""Characters of a request that an answer repeats."""
_HEAD = f"""\
// Written by `sparsestreet serve --proto`: what the server answers, as AlpaSim's interface {wire.API_VERSION[0]}.\
{wire.API_VERSION[1]} has it. Its package
// `common` is folded into this file, which changes no byte of a message. gRPC's own health check and server
// reflection are answered too; both come with gRPC.
syntax = "proto3";

package {wire.PACKAGE};
"""
_Field = descriptor_pb2.FieldDescriptorProto
_Message = descriptor_pb2.DescriptorProto


def proto_text() -> str:
    """Return the interface as one ``.proto``, for protoc and all that is built on it."""
    common, sensorsim = (next(file for file in wire.files() if file.package == one) for one in ("common", wire.PACKAGE))
    blocks = [_message(one) for file in (common, sensorsim) for one in file.message_type]
    blocks += [_enum(one) for one in sensorsim.enum_type]
    for service in sensorsim.service:
        calls = [
            f"  rpc {one.name}({_bare(one.input_type)}) returns ({_bare(one.output_type)});" for one in service.method
        ]
        blocks.append([f"service {service.name} {{", *calls, "}"])
    return _HEAD + "".join("\n" + "\n".join(block) + "\n" for block in blocks)


def _message(message: _Message) -> list[str]:
    inner = [line for one in message.nested_type for line in _message(one)]
    inner += [line for one in message.enum_type for line in _enum(one)]
    inner += [_field(one) for one in message.field if not one.HasField("oneof_index")]
    for number, group in enumerate(message.oneof_decl):
        own = [one for one in message.field if one.HasField("oneof_index") and one.oneof_index == number]
        inner += [f"oneof {group.name} {{", *(f"  {_field(one)}" for one in own), "}"]
    return [f"message {message.name} {{", *(f"  {line}" for line in inner), "}"]


def _enum(enum: descriptor_pb2.EnumDescriptorProto) -> list[str]:
    return [f"enum {enum.name} {{", *(f"  {one.name} = {one.number};" for one in enum.value), "}"]


def _field(field: _Field) -> str:
    kind = _bare(field.type_name) or _Field.Type.Name(field.type).removeprefix("TYPE_").lower()
    repeated = "repeated " if field.label == _Field.LABEL_REPEATED else ""
    return f"{repeated}{kind} {field.name} = {field.number};"


def _bare(kind: str) -> str:
    """The name of a message in the one package of the text."""
    return kind.removeprefix(".common.").removeprefix(f".{wire.PACKAGE}.")


def reflected(request: Any) -> Any:
    """Return the answer to a message of server reflection; what is not there is an error within the answer."""
    package = request.DESCRIPTOR.file.package
    answer = wire.kind(f"{package}.ServerReflectionResponse")(valid_host=request.host, original_request=request)
    asked = request.WhichOneof("message_request")
    try:
        if asked == "list_services":
            for name in sorted(f"{file.package}.{one.name}" for file in wire.files() for one in file.service):
                answer.list_services_response.service.add(name=name)
        elif asked == "file_by_filename":
            _add_files(answer, wire.pool().FindFileByName(request.file_by_filename))
        elif asked == "file_containing_symbol":
            _add_files(answer, wire.pool().FindFileContainingSymbol(request.file_containing_symbol))
        elif asked == "all_extension_numbers_of_type":
            kind = wire.pool().FindMessageTypeByName(request.all_extension_numbers_of_type)
            answer.all_extension_numbers_response.base_type_name = kind.full_name  # proto3 has no extensions
        elif asked == "file_containing_extension":
            raise KeyError(request.file_containing_extension.containing_type)
        else:
            _refuse(answer, grpc.StatusCode.INVALID_ARGUMENT, "the message asks for nothing: send list_services")
    except KeyError:
        said = str(getattr(request, asked))[:MAX_SAID]
        _refuse(answer, grpc.StatusCode.NOT_FOUND, f"there is no {said!r}: list_services tells what there is")
    return answer


def _refuse(answer: Any, code: grpc.StatusCode, said: str) -> None:
    answer.error_response.error_code, answer.error_response.error_message = code.value[0], said


def _add_files(answer: Any, file: Any) -> None:
    """Add the file and all that it needs, so that nobody has to ask again."""
    needed: dict[str, Any] = {}
    _collect(file, needed)
    answer.file_descriptor_response.file_descriptor_proto.extend(one.serialized_pb for one in needed.values())


def _collect(file: Any, needed: dict[str, Any]) -> None:
    for one in file.dependencies:
        _collect(one, needed)
    needed[file.name] = file
