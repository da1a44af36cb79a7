"""The plane's messages as DDS types, named and laid out as ROS 2 has them on the wire.

A type is made from its `.msg` text (`fleet/sortie_msgs`; three standard ones stand below), so that there is no second
definition. A sample is kept as its CDR bytes: `sortie.fleet.messages.wire` writes and reads them, with all its checks, and this module
only tells DDS what they are called. `sortie_msgs/msg/ContextDescriptor` is `sortie_msgs::msg::dds_::ContextDescriptor_`.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, float32, int32, sequence, uint8, uint16, uint32

from sortie.fleet.messages.wire import DESCRIPTOR_MSG, DESCRIPTOR_NAME, DIRECTIVE_MSG, DIRECTIVE_NAME
from sortie.sim.export.topics import BYTES_NAME

DEFINITIONS = {
    DESCRIPTOR_NAME: DESCRIPTOR_MSG,
    DIRECTIVE_NAME: DIRECTIVE_MSG,
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/msg/MultiArrayLayout": "MultiArrayDimension[] dim\nuint32 data_offset",
    BYTES_NAME: "MultiArrayLayout layout\nuint8[] data",
}
"""By ROS 2 name."""

_PRIMITIVES = {"uint8": uint8, "uint16": uint16, "uint32": uint32, "int32": int32, "float32": float32, "string": str}
_FIELD = re.compile(r"(?P<type>[A-Za-z0-9_/]+)(?:\[(?P<length>\d*)\])?\s+(?P<name>[a-z][a-z0-9_]*)")


class Cdr:
    """How a sample of every type made here behaves: it is its CDR bytes, encapsulation header included."""

    def __init__(self, cdr: bytes) -> None:
        self.cdr = cdr

    def serialize(self, buffer: object = None, endianness: object = None, use_version_2: object = None) -> bytes:
        """As DDS asks for it."""
        return self.cdr

    @classmethod
    def deserialize(cls, data: bytes, has_header: bool = True, use_version_2: object = None) -> Cdr:
        """As DDS hands it over; nothing is believed yet."""
        return cls(data)

    @classmethod
    def deserialize_key(cls, data: bytes, has_header: bool = True, use_version_2: object = None) -> Cdr:
        """Of a writer that left: there are no keys, and DDS wraps this so that it is no sample."""
        return cls(data)


def dds_name(ros_name: str) -> str:
    """`pkg/msg/Name` as DDS knows it: `pkg::msg::dds_::Name_`."""
    package, kind, name = ros_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


@cache
def dds_type(ros_name: str) -> type[Any]:
    """The DDS type of a ROS 2 message; its samples are `Cdr`.

    Raises:
        KeyError: none of `DEFINITIONS`.
        ValueError: a line that is no field.
    """
    package = ros_name.partition("/")[0]
    fields = {}
    for line in DEFINITIONS[ros_name].splitlines():
        text = line.partition("#")[0].strip()
        if not text:
            continue
        field = _FIELD.fullmatch(text)
        if field is None:
            raise ValueError(f"{ros_name}: {text!r} is no field")
        fields[field["name"]] = _field_type(package, field["type"], field["length"])
    name = f"{ros_name.rpartition('/')[2]}_"
    made: type[Any] = make_idl_struct(name, dds_name(ros_name), fields, dataclassify=False)
    for own in (
        "__init__",
        "serialize",
        "deserialize",
        "deserialize_key",
    ):  # as a base, Cdr would have to be a type of IDL itself
        setattr(made, own, vars(Cdr)[own])
    return made


def _field_type(package: str, text: str, length: str | None) -> Any:
    base = _PRIMITIVES.get(text)
    if base is None:
        base = dds_type(text.replace("/", "/msg/") if "/" in text else f"{package}/msg/{text}")
    if length is None:
        return base
    return array[base, int(length)] if length else sequence[base]  # type: ignore[misc]
