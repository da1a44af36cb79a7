"""What a vehicle says to a ground station, through the wire and pymavlink's parser."""

from __future__ import annotations

import math

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


def asked_for(index: int, name: bytes = b"", system: int = 3) -> list[str]:
    said = answered(mavlink2.MAVLink_param_request_read_message(system, 1, name, index))
    return [m.param_id for m in said]


def test_what_a_drone_answers() -> None:
    """Drone 2 is system 3. Its neighbours' messages are none of its business, and no ATTITUDE was sent yet."""
    version, home, refused = ["COMMAND_ACK", "AUTOPILOT_VERSION"], ["COMMAND_ACK", "HOME_POSITION"], ["COMMAND_ACK"]
    for request, names in (
        (mavlink2.MAVLink_param_request_list_message(0, 0), ["PARAM_VALUE"] * 2),
        (mavlink2.MAVLink_mission_request_list_message(3, 1, 0), ["MISSION_COUNT"]),
        (command(512, 148), version),
        (command(520, 1), version),
        (command(512, 242), home),
        (command(410), home),
        (command(512, 30), refused),
        (command(512, math.nan), refused),
        (command(400), refused),
        (command(400, system=4), []),
        (mavlink2.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), []),
    ):
        said = answered(request)
        assert [m.get_type() for m in said] == names, request
        if "COMMAND_ACK" in names:  # nobody arms or disarms a simulated drone
            unsupported, accepted = mavlink2.MAV_RESULT_UNSUPPORTED, mavlink2.MAV_RESULT_ACCEPTED
            assert said[0].result == (unsupported if names == refused else accepted)
            assert (said[0].target_system, said[0].target_component) == (255, 190)
    assert [system for system in range(5) if asked_for(0, system=system)] == [0, 3]


def test_parameters_are_told_by_place_or_name_and_keep_their_values() -> None:
    for said in (
        answered(mavlink2.MAVLink_param_request_read_message(3, 1, b"BATT_CAPACITY", -1)),
        answered(mavlink2.MAVLink_param_request_read_message(3, 1, b"", 1)),
        answered(mavlink2.MAVLink_param_set_message(3, 1, b"BATT_CAPACITY", 1.0, 9)),
    ):
        (value,) = said
        assert (value.param_id, value.param_value) == ("BATT_CAPACITY", 5200.0)
        assert (value.param_index, value.param_count) == (1, 2)
    assert asked_for(0, b"BATT_CAPACITY") == ["SYSID_THISMAV"], "the place counts before the name"
    assert asked_for(-1, b"NO_SUCH") == asked_for(2, b"BATT_CAPACITY") == []
    assert len(parameter_values({})) == 0


def test_missions_fences_and_rally_points_are_empty_and_stay_so() -> None:
    for kind in (0, 1, 2):
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


def test_files_are_refused_as_pymavlink_s_ftp_reads_it() -> None:
    """Lists, opened and created ones."""
    for sequence, opcode in ((7, 3), (0xFFFF, 4), (40, 10)):
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
