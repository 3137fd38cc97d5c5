"""Our messages against those that others compiled from AlpaSim's files."""

import os
import re
from pathlib import Path

import pytest

from sparsestreet.serving import wire

pb2 = pytest.importorskip(
    "carla_driver_interface._proto.sensorsim_pb2", reason="pip install carla-driver-interface==2.3.1"
)
common_pb2 = pytest.importorskip("carla_driver_interface._proto.common_pb2")

FILES = {"common": common_pb2.DESCRIPTOR, wire.PACKAGE: pb2.DESCRIPTOR}


def facts(descriptor) -> dict[str, object]:
    """Everything that decides what bytes mean, by full name."""
    found: dict[str, object] = {}
    for enum in descriptor.enum_types:
        found[enum.full_name] = {value.name: value.number for value in enum.values}
    for field in descriptor.fields:
        target = field.message_type or field.enum_type
        group = field.containing_oneof
        found[field.full_name] = (
            field.number,
            field.type,
            field.is_repeated,
            target and target.full_name,
            group and group.name,
        )
    for nested in descriptor.nested_types:
        found |= {nested.full_name: "message"} | facts(nested)
    return found


def file_facts(file) -> dict[str, object]:
    found: dict[str, object] = {
        enum.full_name: {value.name: value.number for value in enum.values} for enum in file.enum_types_by_name.values()
    }
    for message in file.message_types_by_name.values():
        found |= {message.full_name: "message"} | facts(message)
    return found


@pytest.mark.parametrize("package", FILES)
def test_messages_have_the_names_numbers_and_types_of_an_independent_package(package):
    theirs = file_facts(FILES[package])
    ours = file_facts(wire.kind(f"{package}.{'Pose' if package == 'common' else 'PosePair'}").DESCRIPTOR.file)
    assert len(theirs) > 30
    assert ours == theirs


def test_the_calls_are_those_of_the_independent_package():
    service = pb2.DESCRIPTOR.services_by_name["SensorsimService"]
    assert service.full_name == wire.SERVICES[0]
    theirs = {one.name: (one.input_type.full_name, one.output_type.full_name) for one in service.methods}
    ours = {
        name: tuple(kind if kind.startswith("common.") else f"{wire.PACKAGE}.{kind}" for kind in kinds)
        for name, kinds in wire.METHODS.items()
    }
    assert ours == theirs


def test_bytes_of_one_are_read_by_the_other():
    theirs = pb2.RGBRenderRequest(scene_id="sträße", frame_start_us=2**63, image_quality=0.1)
    theirs.camera_intrinsics.opencv_pinhole_param.radial_coeffs.extend([0.1, -0.2])
    theirs.dynamic_objects.add(track_id="car").pose_pair.start_pose.quat.w = 1
    ours = wire.kind("RGBRenderRequest").FromString(theirs.SerializeToString())
    assert ours.camera_intrinsics.WhichOneof("camera_param") == "opencv_pinhole_param"
    assert pb2.RGBRenderRequest.FromString(ours.SerializeToString()) == theirs


ANY = {"common": "Pose", wire.PACKAGE: "PosePair"}
"""A message of each file."""
SCALARS = {"double", "float", "fixed64", "uint32", "uint64", "bool", "string", "bytes"}


def entries_of(text: str) -> set[tuple[str, str | None, str, str]]:
    """Read a file without a compiler: each field and each value of an enum as ``name = number`` in its block."""
    text = re.sub(r"//[^\n]*", "", text)
    found, where = set(), []
    for head, ends, entry in re.findall(r"(?:message|enum|oneof|service)\s+(\w+)\s*\{|(\})|([^{};]+);", text):
        if head:
            where.append(head)
        elif ends:
            where.pop() if where else None
        elif (field := re.match(r"\s*(repeated\s+)?([\w.]*)\s+(\w+)\s*=\s*(\d+)", entry)) and where:
            _, kind, name, number = field.groups()
            found.add((where[-1], None if kind in SCALARS else kind.split(".")[-1], name, number))
        elif (value := re.match(r"\s*(\w+)\s*=\s*(\d+)", entry)) and where:
            found.add((where[-1], "", *value.groups()))
    return found


def entries_by(facts: dict[str, object]) -> set[tuple[str, str | None, str, str]]:
    """The same of a descriptor."""
    found = set()
    for full, fact in facts.items():
        if isinstance(fact, dict):
            found |= {(full.split(".")[-1], "", name, str(number)) for name, number in fact.items()}
        elif isinstance(fact, tuple):
            number, _, _, target, group = fact
            home = group or full.split(".")[-2]
            found.add((home, None if target is None else target.split(".")[-1], full.split(".")[-1], str(number)))
    return found


@pytest.mark.parametrize(("file", "package"), [("common.proto", "common"), ("sensorsim.proto", wire.PACKAGE)])
def test_messages_are_those_of_alpasims_own_files(file, package):
    folder = Path(os.environ.get("SPARSESTREET_DATA", "-")) / "alpasim_grpc"
    found = sorted(folder.rglob(file)) if folder.is_dir() else []
    if not found:
        pytest.skip("SPARSESTREET_DATA has no alpasim_grpc/ with AlpaSim's interface files")
    said = entries_of(found[0].read_text())
    assert len(said) > 20
    assert said == entries_by(file_facts(wire.kind(f"{package}.{ANY[package]}").DESCRIPTOR.file))
