"""What a simulated vehicle says to a ground station: texts, parameters, and answers to requests.

Nothing that a ground station sends changes a sortie. Commands are refused, missions are empty, parameters keep their
values, and there is no file system.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Mapping

from pymavlink.dialects.v20 import common as mavlink2

TEXT_BYTES = 50
"""Of one STATUSTEXT; longer texts go in several."""
_LONGEST_TEXT = TEXT_BYTES * 0xFF
_ASCII = {"→": "->", "ρ": "rho", "τ": "tau", "×": "x", "–": "-", "−": "-", "…": "...", "≤": "<=", "≥": ">=", "·": "*"}
_MISSION_UPLOADS = ("MISSION_COUNT", "MISSION_WRITE_PARTIAL_LIST")
_MISSION_ITEMS = ("MISSION_REQUEST", "MISSION_REQUEST_INT")
_COMMANDS = ("COMMAND_LONG", "COMMAND_INT")
_VERSION_ID = mavlink2.MAVLINK_MSG_ID_AUTOPILOT_VERSION
_ASKS_FOR = {
    mavlink2.MAV_CMD_GET_HOME_POSITION: mavlink2.MAVLINK_MSG_ID_HOME_POSITION,
    mavlink2.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _VERSION_ID,
}
"""Older commands that ask for one message."""
_FTP_NAK, _FTP_UNKNOWN_COMMAND = 129, 7
_FTP_SEQUENCE, _FTP_SESSION, _FTP_OPCODE, _FTP_SIZE, _FTP_REQUEST, _FTP_DATA = slice(0, 2), 2, 3, 4, 5, 12
_FTP_BYTES = 251


def status_texts(text: str, number: int, *, warning: bool = False) -> list[mavlink2.MAVLink_message]:
    """A text as STATUSTEXT messages in ASCII: one, or for over 50 bytes several that ground stations join.

    Args:
        text: at most 12,750 bytes are sent.
        number: of the text among those of its vehicle; it tells the parts of one text from those of another.
        warning: severity WARNING instead of INFO.

    Example:
        >>> [m.text for m in status_texts("drone 2 → 0: nothing", 1)]
        ['drone 2 -> 0: nothing']
    """
    severity = mavlink2.MAV_SEVERITY_WARNING if warning else mavlink2.MAV_SEVERITY_INFO
    for sign, plain in _ASCII.items():
        text = text.replace(sign, plain)
    data = unicodedata.normalize("NFKD", text).encode("ascii", "ignore")[:_LONGEST_TEXT]
    if len(data) <= TEXT_BYTES:
        return [mavlink2.MAVLink_statustext_message(severity, data)]
    parts = [
        data[at : at + TEXT_BYTES] for at in range(0, len(data) + 1, TEXT_BYTES)
    ]  # a last part below 50 bytes ends it
    name = 1 + number % 0xFFFF
    return [mavlink2.MAVLink_statustext_message(severity, part, name, k) for k, part in enumerate(parts)]


def parameter_values(parameters: Mapping[str, float]) -> list[mavlink2.MAVLink_message]:
    """Every parameter as PARAM_VALUE, numbered in the mapping's order."""
    return [
        mavlink2.MAVLink_param_value_message(
            name.encode("ascii"), value, mavlink2.MAV_PARAM_TYPE_REAL32, len(parameters), index
        )
        for index, (name, value) in enumerate(parameters.items())
    ]


def answers(
    request: mavlink2.MAVLink_message,
    drone: int,
    parameters: Mapping[str, float],
    latest: Mapping[int, mavlink2.MAVLink_message],
) -> list[mavlink2.MAVLink_message]:
    """What a drone answers to a ground station's message; nothing to one that is for another system.

    Args:
        request: what came in.
        drone: who answers, system id drone + 1.
        parameters: the vehicle's, by names of at most 16 characters.
        latest: the last message that the vehicle sent of each kind, by message id.
    """
    asked, target = request.get_type(), getattr(request, "target_system", 0)
    if target not in (0, drone + 1):
        return []
    if asked in ("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET"):
        return _parameters(request, parameter_values(parameters))
    if asked.startswith("MISSION_"):
        return _mission(request)
    if asked in _COMMANDS:
        return _command(request, drone, latest)
    if asked == "FILE_TRANSFER_PROTOCOL" and request.payload[_FTP_OPCODE] < _FTP_NAK - 1:  # not itself an answer
        return [_no_files(request)]
    return []


def _parameters(
    request: mavlink2.MAVLink_message, values: list[mavlink2.MAVLink_message]
) -> list[mavlink2.MAVLink_message]:
    """All of them, or the one that is meant; one that is set is told unchanged."""
    if request.get_type() == "PARAM_REQUEST_LIST":
        return values
    index = getattr(request, "param_index", -1)
    if index >= 0:
        return values[index : index + 1]
    return [value for value in values if value.param_id == request.param_id]


def _mission(request: mavlink2.MAVLink_message) -> list[mavlink2.MAVLink_message]:
    """There are no mission items, fences or rally points; clearing them succeeds, and new ones are refused."""
    asked, sender = request.get_type(), (request.get_srcSystem(), request.get_srcComponent())
    if asked == "MISSION_REQUEST_LIST":
        return [mavlink2.MAVLink_mission_count_message(*sender, 0, request.mission_type)]
    if asked == "MISSION_CLEAR_ALL":
        result = mavlink2.MAV_MISSION_ACCEPTED
    elif asked in _MISSION_UPLOADS:
        result = mavlink2.MAV_MISSION_DENIED
    elif asked in _MISSION_ITEMS:
        result = mavlink2.MAV_MISSION_INVALID_SEQUENCE
    else:
        return []
    return [mavlink2.MAVLink_mission_ack_message(*sender, result, request.mission_type)]


def _command(
    request: mavlink2.MAVLink_message, drone: int, latest: Mapping[int, mavlink2.MAVLink_message]
) -> list[mavlink2.MAVLink_message]:
    """A message that is asked for is sent once; every other command is refused."""
    wanted: float | None = _ASKS_FOR.get(request.command)
    if request.command == mavlink2.MAV_CMD_REQUEST_MESSAGE:
        wanted = request.param1  # a float, and perhaps no number
    known = {**latest, _VERSION_ID: _version(drone)}
    message = known.get(int(wanted)) if wanted is not None and math.isfinite(wanted) else None
    result = mavlink2.MAV_RESULT_UNSUPPORTED if message is None else mavlink2.MAV_RESULT_ACCEPTED
    to = (request.get_srcSystem(), request.get_srcComponent())
    ack = mavlink2.MAVLink_command_ack_message(request.command, result, 0, 0, *to)
    return [ack] if message is None else [ack, message]


def _version(drone: int) -> mavlink2.MAVLink_message:
    none = bytes(8)
    return mavlink2.MAVLink_autopilot_version_message(
        mavlink2.MAV_PROTOCOL_CAPABILITY_MAVLINK2, 0, 0, 0, 0, none, none, none, 0, 0, drone + 1
    )


def _no_files(request: mavlink2.MAVLink_message) -> mavlink2.MAVLink_message:
    """NAK with the error *unknown command*: the session ends at once, and nobody waits for a time-out."""
    asked, answer = request.payload, [0] * _FTP_BYTES
    sequence = (int.from_bytes(bytes(asked[_FTP_SEQUENCE]), "little") + 1) % 0x10000
    answer[_FTP_SEQUENCE] = sequence.to_bytes(2, "little")
    answer[_FTP_SESSION] = asked[_FTP_SESSION]
    answer[_FTP_OPCODE], answer[_FTP_REQUEST] = _FTP_NAK, asked[_FTP_OPCODE]
    answer[_FTP_SIZE], answer[_FTP_DATA] = 1, _FTP_UNKNOWN_COMMAND
    return mavlink2.MAVLink_file_transfer_protocol_message(
        0, request.get_srcSystem(), request.get_srcComponent(), answer
    )
