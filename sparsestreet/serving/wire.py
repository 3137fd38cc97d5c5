"""The messages of ``SensorsimService``, by which AlpaSim and NuRec ask a renderer for pictures, and of gRPC's own.

The tables below are all there is: descriptors are made of them at import, in a pool of their own, so no code is
generated and no version of protobuf is pinned. They agree with version 0.55 of AlpaSim's interface (Apache-2.0);
``tests/serving/test_wire.py`` compares each name, number and type.

A line is a message and its fields: ``name:number type``, ``*type`` for a repeated one, ``type|group`` for one of a
group of which at most one is set. ``enum`` begins a line of names and numbers; ``A.B`` is declared within ``A``.
"""

from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

API_VERSION = (0, 55, 0)

COMMON = """
Empty
Quat: w:1 float, x:2 float, y:3 float, z:4 float
Vec3: x:1 float, y:2 float, z:3 float
Pose: vec:1 Vec3, quat:2 Quat
DynamicState: angular_velocity:1 Vec3, linear_velocity:2 Vec3, linear_acceleration:3 Vec3, angular_acceleration:4 Vec3
AABB: size_x:1 float, size_y:2 float, size_z:3 float
PoseAtTime: pose:1 Pose, timestamp_us:2 fixed64
StateAtTime: timestamp_us:1 fixed64, pose:2 Pose, state:3 DynamicState
Trajectory: poses:1 *PoseAtTime
VersionId: version_id:1 string, git_hash:2 string, grpc_api_version:3 VersionId.APIVersion
VersionId.APIVersion: major:1 uint32, minor:2 uint32, patch:3 uint32
SessionRequestStatus
AvailableScenesReturn: scene_ids:1 *string
"""

SENSORSIM = """
LoadedSceneEntry: scene_id:1 string, loaded_instance_count:2 uint64, reusable_instance_count:3 uint64
LoadedScenesReturn: scenes:1 *LoadedSceneEntry, loaded_instance_capacity:2 uint64
EgoMaskId: camera_logical_id:1 string, rig_config_id:2 string
AvailableEgoMasksReturn: ego_mask_metadata:1 *AvailableEgoMasksReturn.EgoMaskMetadata
AvailableEgoMasksReturn.EgoMaskMetadata: ego_mask_id:1 EgoMaskId
enum ShutterType: UNKNOWN 0, ROLLING_TOP_TO_BOTTOM 1, ROLLING_LEFT_TO_RIGHT 2, ROLLING_BOTTOM_TO_TOP 3, \
ROLLING_RIGHT_TO_LEFT 4, GLOBAL 5
LinearCde: linear_c:1 double, linear_d:2 double, linear_e:3 double
FthetaCameraParam: principal_point_x:1 double, principal_point_y:2 double, \
reference_poly:3 FthetaCameraParam.PolynomialType, pixeldist_to_angle_poly:4 *double, \
angle_to_pixeldist_poly:5 *double, max_angle:6 double, linear_cde:7 LinearCde
enum FthetaCameraParam.PolynomialType: UNKNOWN 0, PIXELDIST_TO_ANGLE 1, ANGLE_TO_PIXELDIST 2
OpenCVPinholeCameraParam: principal_point_x:1 double, principal_point_y:2 double, focal_length_x:3 double, \
focal_length_y:4 double, radial_coeffs:5 *double, tangential_coeffs:6 *double, thin_prism_coeffs:7 *double
OpenCVFisheyeCameraParam: principal_point_x:1 double, principal_point_y:2 double, focal_length_x:3 double, \
focal_length_y:4 double, radial_coeffs:5 *double, max_angle:6 double
BivariateWindshieldModelParameters: reference_poly:1 BivariateWindshieldModelParameters.ReferencePolynomial, \
horizontal_poly:2 *double, vertical_poly:3 *double, horizontal_poly_inverse:4 *double, vertical_poly_inverse:5 *double
enum BivariateWindshieldModelParameters.ReferencePolynomial: FORWARD 0, BACKWARD 1
CameraSpec: temporary_camera_spec:1 string, ftheta_param:2 FthetaCameraParam|camera_param, \
opencv_pinhole_param:3 OpenCVPinholeCameraParam|camera_param, \
opencv_fisheye_param:4 OpenCVFisheyeCameraParam|camera_param, logical_id:5 string, resolution_h:7 uint32, \
resolution_w:8 uint32, shutter_type:9 ShutterType, \
bivariate_windshield_model_param:10 BivariateWindshieldModelParameters|external_distortion
PosePair: start_pose:1 common.Pose, end_pose:2 common.Pose
DynamicObject: track_id:1 string, pose_pair:2 PosePair
enum ImageFormat: UNDEFINED 0, PNG 1, JPEG 2, JPEG2000 3, RGB_UINT8_PLANAR 4, AVC 5, AV1 6
RGBRenderRequest: scene_id:1 string, resolution_h:2 uint32, resolution_w:3 uint32, camera_intrinsics:4 CameraSpec, \
frame_start_us:5 fixed64, frame_end_us:6 fixed64, sensor_pose:7 PosePair, dynamic_objects:8 *DynamicObject, \
image_format:9 ImageFormat, image_quality:10 float, insert_ego_mask:11 bool, ego_mask_id:12 EgoMaskId
RGBRenderReturn: image_bytes:1 bytes
AvailableCamerasRequest: scene_id:1 string
AvailableCamerasReturn: available_cameras:1 *AvailableCamerasReturn.AvailableCamera
AvailableCamerasReturn.AvailableCamera: intrinsics:1 CameraSpec, rig_to_camera:2 common.Pose, logical_id:3 string
AvailableTrajectoriesRequest: scene_id:1 string
AvailableTrajectoriesReturn: available_trajectories:1 *AvailableTrajectoriesReturn.AvailableTrajectory
AvailableTrajectoriesReturn.AvailableTrajectory: trajectory:2 common.Trajectory
enum LidarDeviceType: PANDAR128 0, AT128 1
LidarSpec: lidar_type:2 LidarDeviceType
LidarRenderReturn: point_xyzs:1 *float, point_intensities:2 *float, num_points:3 uint32, \
point_xyzs_buffer:4 bytes, point_intensities_buffer:5 bytes
LidarRenderRequest: scene_id:1 string, lidar_config:2 LidarSpec, frame_start_us:3 fixed64, frame_end_us:4 fixed64, \
sensor_pose:5 PosePair, dynamic_objects:6 *DynamicObject
BatchRGBRenderRequest: items:1 *BatchRGBRenderRequestItem
BatchRGBRenderRequestItem: camera_name:1 string, request:2 RGBRenderRequest
BatchRGBRenderReturn: items:1 *BatchRGBRenderReturnItem
BatchRGBRenderReturnItem: camera_name:1 string, result:2 RGBRenderReturn, success:3 bool, error_message:4 string
AggregatedRenderRequest: rgb_requests:1 *RGBRenderRequest, lidar_requests:2 *LidarRenderRequest
AggregatedRenderReturn: rgb_returns:1 *RGBRenderReturn, lidar_returns:2 *LidarRenderReturn, driver_data:3 bytes
"""

HEALTH = """
HealthCheckRequest: service:1 string
HealthCheckResponse: status:1 HealthCheckResponse.ServingStatus
enum HealthCheckResponse.ServingStatus: UNKNOWN 0, SERVING 1, NOT_SERVING 2, SERVICE_UNKNOWN 3
"""

REFLECTION = """
ServerReflectionRequest: host:1 string, file_by_filename:3 string|message_request, \
file_containing_symbol:4 string|message_request, file_containing_extension:5 ExtensionRequest|message_request, \
all_extension_numbers_of_type:6 string|message_request, list_services:7 string|message_request
ExtensionRequest: containing_type:1 string, extension_number:2 int32
ServerReflectionResponse: valid_host:1 string, original_request:2 ServerReflectionRequest, \
file_descriptor_response:4 FileDescriptorResponse|message_response, \
all_extension_numbers_response:5 ExtensionNumberResponse|message_response, \
list_services_response:6 ListServiceResponse|message_response, error_response:7 ErrorResponse|message_response
FileDescriptorResponse: file_descriptor_proto:1 *bytes
ExtensionNumberResponse: base_type_name:1 string, extension_number:2 *int32
ListServiceResponse: service:1 *ServiceResponse
ServiceResponse: name:1 string
ErrorResponse: error_code:1 int32, error_message:2 string
"""

PACKAGE = "nre.grpc.protos.sensorsim"
SERVICES = (f"{PACKAGE}.SensorsimService", "sensorsim.SensorsimService")
"""The same calls by both names: the second is NuRec's from its version 26.10 on."""

METHODS = {
    "render_rgb": ("RGBRenderRequest", "RGBRenderReturn"),
    "render_lidar": ("LidarRenderRequest", "LidarRenderReturn"),
    "render_aggregated": ("AggregatedRenderRequest", "AggregatedRenderReturn"),
    "batch_render_rgb": ("BatchRGBRenderRequest", "BatchRGBRenderReturn"),
    "get_version": ("common.Empty", "common.VersionId"),
    "get_available_scenes": ("common.Empty", "common.AvailableScenesReturn"),
    "get_loaded_scenes": ("common.Empty", "LoadedScenesReturn"),
    "get_available_cameras": ("AvailableCamerasRequest", "AvailableCamerasReturn"),
    "get_available_trajectories": ("AvailableTrajectoriesRequest", "AvailableTrajectoriesReturn"),
    "get_available_ego_masks": ("common.Empty", "AvailableEgoMasksReturn"),
}
"""Name of a call -> its request and its answer."""

HEALTH_METHODS = {
    "Check": ("HealthCheckRequest", "HealthCheckResponse"),
    "Watch": ("HealthCheckRequest", "stream HealthCheckResponse"),
}
REFLECTION_METHODS = {"ServerReflectionInfo": ("stream ServerReflectionRequest", "stream ServerReflectionResponse")}
REFLECTIONS = ("grpc.reflection.v1", "grpc.reflection.v1alpha")
"""Packages of the same messages and the same call: many tools ask for the older one first."""

_PACKAGES = {"common": COMMON, PACKAGE: SENSORSIM, "sensorsim": "", "grpc.health.v1": HEALTH}
_PACKAGES |= dict.fromkeys(REFLECTIONS, REFLECTION)
_NEEDS = {PACKAGE: ("common",), "sensorsim": ("common", PACKAGE)}
_SERVICES = dict.fromkeys(SERVICES, METHODS) | {"grpc.health.v1.Health": HEALTH_METHODS}
_SERVICES |= {f"{package}.ServerReflection": REFLECTION_METHODS for package in REFLECTIONS}
_Field = descriptor_pb2.FieldDescriptorProto


@cache
def kind(name: str) -> Any:
    """The class of a message, by its name with its package; without a package it is one of SensorsimService.

    >>> kind("common.Vec3")(x=1.5).x
    1.5
    """
    whole = any(name.startswith(f"{package}.") for package in _PACKAGES)
    return message_factory.GetMessageClass(pool().FindMessageTypeByName(name if whole else f"{PACKAGE}.{name}"))


def files() -> list[descriptor_pb2.FileDescriptorProto]:
    """Return all that the server answers, each file behind those that it needs."""
    made = [_file(*one) for one in _PACKAGES.items()]
    for name, methods in _SERVICES.items():
        package, _, service = name.rpartition(".")
        home = PACKAGE if package == "sensorsim" else package
        listed = next(file for file in made if file.package == package).service.add(name=service)
        for call, kinds in methods.items():
            asked, answered = (_full(kind.removeprefix("stream "), home) for kind in kinds)
            method = listed.method.add(name=call, input_type=asked, output_type=answered)
            method.client_streaming, method.server_streaming = (kind.startswith("stream ") for kind in kinds)
    return made


@cache
def number(enum: str, name: str) -> int:
    """The number of a name of an enum of SensorsimService.

    >>> number("ImageFormat", "JPEG")
    2
    """
    return pool().FindEnumTypeByName(f"{PACKAGE}.{enum}").values_by_name[name].number


@cache
def word(enum: str, number: int) -> str:
    """The name of a number of an enum; the number itself if it has none."""
    found = pool().FindEnumTypeByName(f"{PACKAGE}.{enum}").values_by_number.get(number)
    return str(number) if found is None else found.name


@cache
def pool() -> Any:
    """Return the descriptors of ``files``, by their names."""
    made = descriptor_pool.DescriptorPool()
    for file in files():
        made.AddSerializedFile(file.SerializeToString())
    return made


def _file(package: str, table: str) -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
    file.dependency.extend(f"{one}.proto" for one in _NEEDS.get(package, ()))
    lines = [line.partition(": ") for line in table.strip().splitlines()]
    enums = {head.removeprefix("enum ") for head, _, _ in lines if head.startswith("enum ")}
    messages: dict[str, descriptor_pb2.DescriptorProto] = {}
    for head, _, _ in lines:
        outer, _, inner = head.rpartition(".")
        if not head.startswith("enum "):
            home = messages[outer].nested_type if outer else file.message_type
            messages[head] = home.add(name=inner)
    for head, _, said in lines:
        entries = said.split(", ") if said else []
        if head.startswith("enum "):
            outer, _, inner = head.removeprefix("enum ").rpartition(".")
            made = (messages[outer] if outer else file).enum_type.add(name=inner)
            for entry in entries:
                value, _, count = entry.partition(" ")
                made.value.add(name=value, number=int(count))
        else:
            for entry in entries:
                _add_field(messages[head], entry, package, enums)
    return file


def _full(kind: str, package: str) -> str:
    return f".{kind}" if kind.startswith("common.") else f".{package}.{kind}"


def _add_field(message: descriptor_pb2.DescriptorProto, entry: str, package: str, enums: set[str]) -> None:
    name, _, rest = entry.partition(":")
    place, _, kind = rest.partition(" ")
    kind, _, group = kind.partition("|")
    field = message.field.add(name=name, number=int(place), label=_Field.LABEL_OPTIONAL)
    if kind.startswith("*"):
        kind, field.label = kind[1:], _Field.LABEL_REPEATED
    if kind[0].islower() and "." not in kind:
        field.type = getattr(_Field, f"TYPE_{kind.upper()}")
    else:
        field.type = _Field.TYPE_ENUM if kind in enums else _Field.TYPE_MESSAGE
        field.type_name = _full(kind, package)
    if group:
        groups = [one.name for one in message.oneof_decl]
        if group not in groups:
            message.oneof_decl.add(name=group)
            groups.append(group)
        field.oneof_index = groups.index(group)
