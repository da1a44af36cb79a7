"""What a vehicle says to a ground station, through the wire and pymavlink's parser; texts are joined as a ground station does."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavftp_op
from pymavlink.dialects.v20 import common as mavlink2

from sortie.fleet.logs.ground_station import answers, parameter_values, status_texts
from sortie.fleet.logs.mavlink import Listener, Transmitter

PARAMETERS = {"SYSID_THISMAV": 3.0, "BATT_CAPACITY": 5200.0}
HOME = mavlink2.MAVLink_home_position_message(470000000, 85000000, 400000, 1.0, 2.0, 3.0, [1.0, 0.0, 0.0, 0.0], 0, 0, 0)
LATEST = {HOME.get_msgId(): HOME}


def answered(request: mavlink2.MAVLink_message) -> list[mavlink2.MAVLink_message]:
    """What drone 2 answers to station 255, component 190."""
    station = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)
    (heard,) = Listener().heard(bytes(request.pack(station)))
    transmitter, parser = Transmitter(2), mavlink2.MAVLink(None)
    return [
        m for said in answers(heard, 2, PARAMETERS, LATEST) for m in parser.parse_buffer(transmitter.pack(said)) or []
    ]


def command(number: int, first: float = 0.0, system: int = 3) -> mavlink2.MAVLink_message:
    return mavlink2.MAVLink_command_long_message(system, 1, number, 0, first, 0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("request_", "names"),
    [
        (mavlink2.MAVLink_param_request_list_message(0, 0), ["PARAM_VALUE"] * 2),
        (mavlink2.MAVLink_mission_request_list_message(3, 1, 0), ["MISSION_COUNT"]),
        (command(512, 148), ["COMMAND_ACK", "AUTOPILOT_VERSION"]),
        (command(520, 1), ["COMMAND_ACK", "AUTOPILOT_VERSION"]),
        (command(512, 242), ["COMMAND_ACK", "HOME_POSITION"]),
        (command(410), ["COMMAND_ACK", "HOME_POSITION"]),
        (command(512, 30), ["COMMAND_ACK"]),  # no ATTITUDE was sent yet
        (command(512, math.nan), ["COMMAND_ACK"]),
        (command(400), ["COMMAND_ACK"]),
        (command(400, system=4), []),
        (mavlink2.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), []),
    ],
)
def test_what_a_drone_answers(request_: mavlink2.MAVLink_message, names: list[str]) -> None:
    said = answered(request_)
    assert [m.get_type() for m in said] == names
    if "COMMAND_ACK" in names:  # nobody arms or disarms a simulated drone
        refused = names == ["COMMAND_ACK"]
        assert said[0].result == (mavlink2.MAV_RESULT_UNSUPPORTED if refused else mavlink2.MAV_RESULT_ACCEPTED)
        assert (said[0].target_system, said[0].target_component) == (255, 190)


def test_parameters_are_told_and_keep_their_values() -> None:
    by_name = answered(mavlink2.MAVLink_param_request_read_message(3, 1, b"BATT_CAPACITY", -1))
    by_index = answered(mavlink2.MAVLink_param_request_read_message(3, 1, b"", 1))
    written = answered(mavlink2.MAVLink_param_set_message(3, 1, b"BATT_CAPACITY", 1.0, 9))
    for said in (by_name, by_index, written):
        (value,) = said
        assert (value.param_id, value.param_value, value.param_index, value.param_count) == (
            "BATT_CAPACITY", 5200.0, 1, 2,
        )  # fmt: skip
    assert answered(mavlink2.MAVLink_param_request_read_message(3, 1, b"NO_SUCH", -1)) == []
    assert answered(mavlink2.MAVLink_param_request_read_message(3, 1, b"", 2)) == []
    assert len(parameter_values({})) == 0


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_missions_fences_and_rally_points_are_empty_and_stay_so(kind: int) -> None:
    (count,) = answered(mavlink2.MAVLink_mission_request_list_message(3, 1, kind))
    assert (count.count, count.mission_type, count.target_system) == (0, kind, 255)
    for request, result in (
        (mavlink2.MAVLink_mission_clear_all_message(3, 1, kind), mavlink2.MAV_MISSION_ACCEPTED),
        (mavlink2.MAVLink_mission_count_message(3, 1, 5, kind), mavlink2.MAV_MISSION_DENIED),
        (mavlink2.MAVLink_mission_request_int_message(3, 1, 0, kind), mavlink2.MAV_MISSION_INVALID_SEQUENCE),
    ):
        (ack,) = answered(request)
        assert (ack.get_type(), ack.type, ack.mission_type) == ("MISSION_ACK", result, kind)
    assert answered(mavlink2.MAVLink_mission_ack_message(3, 1, 0, kind)) == []


@pytest.mark.parametrize(("sequence", "opcode"), [(7, 3), (0xFFFF, 4), (40, 10)], ids=["list", "open", "create"])
def test_files_are_refused_as_pymavlink_s_ftp_reads_it(sequence: int, opcode: int) -> None:
    asked = bytes([*sequence.to_bytes(2, "little"), 5, opcode, 1, 0, 0, 0, 0, 0, 0, 0]) + b"/"
    payload = list(asked.ljust(251, b"\0"))
    (said,) = answered(mavlink2.MAVLink_file_transfer_protocol_message(0, 3, 1, payload))
    assert (said.get_type(), said.target_system, said.target_component) == ("FILE_TRANSFER_PROTOCOL", 255, 190)
    head = bytes(said.payload)
    read = mavftp_op.FTP_OP(int.from_bytes(head[:2], "little"), *head[2:7], 0, bytearray(head[12 : 12 + head[4]]))
    assert (read.seq, read.session, read.opcode, read.req_opcode) == ((sequence + 1) % 65536, 5, 129, opcode)
    assert read.payload == bytes([7])  # unknown command
    echoed = mavlink2.MAVLink_file_transfer_protocol_message(0, 3, 1, list(head.ljust(251, b"\0")))
    assert answered(echoed) == []  # two drones do not refuse each other's refusals for ever


@given(st.text(max_size=300), st.integers(0, 10**9))
def test_texts_arrive_whole_in_parts_of_50_bytes(text: str, number: int) -> None:
    texts = status_texts(text, number)
    assert all(len(m.text.encode() if isinstance(m.text, str) else m.text) <= 50 for m in texts)
    transmitter, parser = Transmitter(0), mavlink2.MAVLink(None)
    heard = [m for each in texts for m in parser.parse_buffer(transmitter.pack(each)) or []]
    assert len({m.id for m in heard}) == 1
    assert (heard[0].id == 0) == (len(heard) == 1)
    assert [m.chunk_seq for m in heard] == list(range(len(heard)))
    if len(heard) > 1:
        assert len(heard[-1].text) < 50  # a shorter part ends a text
    if text.isascii() and "\0" not in text:
        assert "".join(m.text for m in heard) == text


def test_signs_have_plain_spellings() -> None:
    (text,) = status_texts("drone 2 → 0: features ρ=0.25, goodput ≤ 5 Mb/s", 1, warning=True)
    assert bytes(text.pack(mavlink2.MAVLink(None)))[11:].startswith(
        b"drone 2 -> 0: features rho=0.25, goodput <= 5 Mb/"
    )
    assert text.severity == mavlink2.MAV_SEVERITY_WARNING
