"""The messages that docs/traces/messages.txt shows octet by octet, made by the code that sends them."""

import numpy as np

from firmware_protocol.can_frames.canopen import (
    EMCY_OVERRUN,
    Emergency,
    NmtCommand,
    NmtOrder,
    NodeState,
    TimeOfDay,
    scet,
)
from firmware_protocol.can_frames.frame import FollowUp
from firmware_protocol.can_frames.raw_events import Epoch, pack_clock, pack_events, pack_fd_events, pack_marks
from firmware_protocol.can_frames.transport import IsoTpReceiver, IsoTpSender, IsoTpSettings, cfp_frames
from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.housekeeping import EventCounts, Housekeeping, LinkCounts, Mode, TimeReport, TimeStatus
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Ping, RequestId, SetTick, Stage, Verification
from firmware_protocol.telemetry.writing import BlockEncoder

__all__ = ["EXAMPLES"]

T_US = 1_500_000
EVENTS = np.array([(T_US, 345, 259, True), (T_US + 100, 1, 2, False)], EVENT)
EDGES = np.array([(T_US, 2, 0, 7)], EDGE)
REPORT = Housekeeping(
    t_us=T_US,
    region=(0, 0, 346, 260),
    mode=Mode.STREAMING,
    time_status=TimeStatus.SET,
    offered_hz=1000,
    sent_hz=900,
    events=EventCounts(offered=1500, sent=1400, waiting=100),
    link=LinkCounts(commands_taken=3),
)


def _packet(kind, payload):
    return Profile("ccsds").wrap(Message(kind, payload, T_US))


def _isotp():
    """The three kinds of ISO-TP frames of a telecommand, with the camera's flow control."""
    computer, camera = IsoTpSettings(0x522, 0x4A2), IsoTpSettings(0x4A2, 0x522)
    sender, receiver = IsoTpSender(computer), IsoTpReceiver(camera)
    sender.start(Profile("ccsds").wrap_command(Ping()))
    first = sender.next_frame(0)
    receiver.push(first, 0)
    sender.flow_control(receiver.reply, 0)
    return first.data, receiver.reply.data, sender.next_frame(0).data


def _examples():
    first, flow, consecutive = _isotp()
    cfp = cfp_frames(Profile("csp").wrap_command(Ping()), 1, 0)
    return {
        "HOUSEKEEPING": _packet(MessageKind.HOUSEKEEPING, REPORT.encode()),
        "VERIFICATION": _packet(
            MessageKind.VERIFICATION,
            Verification(Stage.COMPLETION, RequestId.parse(bytes.fromhex("1aa0c005"))).encode(),
        ),
        "TIME": _packet(MessageKind.TIME, TimeReport(T_US, TimeStatus.SET).encode()),
        "PONG": _packet(MessageKind.PONG, b""),
        "EVENTS": _packet(MessageKind.EVENTS, BlockEncoder((346, 260)).encode(EVENTS)[0]),
        "EDGES": _packet(MessageKind.EDGES, BlockEncoder((346, 260)).encode_edges(EDGES)),
        "SetTick by CSP": Profile("csp").wrap_command(SetTick(100)),
        "events, classic": pack_events(EVENTS, 1, 5)[0][0],
        "events, FD": pack_fd_events(EVENTS, 1, 5, dropped=2)[0][0],
        "epoch": bytes(Epoch(T_US // 100, 100, 1400, 3)),
        "clock": pack_clock(T_US),
        "edges and marks": pack_marks(EDGES)[0],
        "nmt": bytes(NmtOrder(NmtCommand.START, 0x22)),
        "heartbeat": bytes([NodeState.OPERATIONAL]),
        "emcy": bytes(Emergency(EMCY_OVERRUN, 1000)),
        "time": bytes(TimeOfDay(*reversed(divmod(T_US // 1000, 86_400_000)))),
        "scet": scet(T_US),
        "follow_up": bytes(FollowUp(9, T_US * 1000)),
        "ISO-TP first frame": first,
        "ISO-TP flow control": flow,
        "ISO-TP consecutive frame": consecutive,
        "CFP first frame": cfp[0].identifier.to_bytes(4, "big") + cfp[0].data,
        "CFP last frame": cfp[-1].identifier.to_bytes(4, "big") + cfp[-1].data,
    }


EXAMPLES = _examples()
"""Name in docs/traces/messages.txt or docs/packets.md: octets; a CFP frame with its 29-bit identifier in front."""
