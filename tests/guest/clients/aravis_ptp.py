"""Aravis has a camera follow a PTP master: /usr/bin/python3 aravis_ptp.py ADDRESS READINGS; what it saw, as JSON.

The master's time is this machine's CLOCK_REALTIME, so each latched time can be compared with the true one.
"""

import json
import sys
import time

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402

PATIENCE_S = 240.0
BUFFERS = 20
PAUSE_S = 0.1  # between readings: a master of the tests sends a Sync each 0.125 s


def state(device):
    device.execute_command("PtpDataSetLatch")
    return device.get_string_feature_value("PtpStatus")


def follow(device):
    """Switch PTP on and wait for the slave; return the states in order."""
    states = [state(device)]
    device.set_boolean_feature_value("PtpEnable", True)
    end_s = time.monotonic() + PATIENCE_S
    while states[-1] != "Slave" and time.monotonic() < end_s:
        now = state(device)
        states += [now] if now != states[-1] else []
        time.sleep(PAUSE_S / 10)
    return states


def reading(device):
    """One latched time: its error against CLOCK_REALTIME, half of what the request took, and the reported offset."""
    before_ns = time.time_ns()
    device.execute_command("TimestampLatch")
    after_ns = time.time_ns()
    latched_ns = device.get_integer_feature_value("TimestampLatchValue")
    state(device)
    return {
        "error_ns": latched_ns - (before_ns + after_ns) // 2,
        "half_ns": (after_ns - before_ns) // 2,
        "offset_ns": device.get_integer_feature_value("PtpOffsetFromMaster"),
        "delay_ns": device.get_integer_feature_value("PtpMeanPropagationDelay"),
    }


def buffers(camera):
    """Age at arrival of the first blocks by their time stamps, ns."""
    camera.gv_set_stream_options(Aravis.GvStreamOption.PACKET_SOCKET_DISABLED)
    stream = camera.create_stream(None, None)
    for _ in range(BUFFERS):
        stream.push_buffer(Aravis.Buffer.new_allocate(camera.get_payload()))
    camera.start_acquisition()
    ages, end_s = [], time.monotonic() + PATIENCE_S
    while len(ages) < BUFFERS and time.monotonic() < end_s:
        buffer = stream.timeout_pop_buffer(200_000)
        if buffer is not None:
            ages.append(time.time_ns() - buffer.get_timestamp())
            stream.push_buffer(buffer)
    camera.stop_acquisition()
    return ages


def main():
    camera = Aravis.Camera.new(sys.argv[1])
    device = camera.get_device()
    states = follow(device)
    readings = []
    for _ in range(int(sys.argv[2])):
        readings.append(reading(device))
        time.sleep(PAUSE_S)
    seen = {
        "states": states,
        "readings": readings,
        "ages_ns": buffers(camera),
        "end": follow(device)[-1],  # a master that the machine held up is lost for a while
        "servo": device.get_string_feature_value("PtpServoStatus"),
        "parent": device.get_integer_feature_value("PtpParentClockID") & (1 << 64) - 1,
        "clock": device.get_integer_feature_value("PtpClockID") & (1 << 64) - 1,
    }
    print(json.dumps(seen))


main()
