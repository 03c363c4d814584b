"""Aravis reads a GigE Vision camera: /usr/bin/python3 aravis_gige.py ADDRESS OCTETS OUT; what it saw, as JSON."""

import json
import sys
import time

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402

PATIENCE_S = 120.0


def main():
    address, octets, out = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    camera = Aravis.Camera.new(address)
    device = camera.get_device()
    device.set_integer_feature_value("BiasEventThresholdPositive", 30)
    device.execute_command("TimestampLatch")
    told = {
        "model": camera.get_model_name(),
        "bias": device.get_integer_feature_value("BiasEventThresholdPositive"),
        "celsius": device.get_float_feature_value("DeviceTemperature"),
        "format": device.get_string_feature_value("EventFormat"),
        "time_ns": device.get_integer_feature_value("TimestampLatchValue"),
        "packet_size": camera.gv_get_packet_size(),
    }
    camera.gv_set_stream_options(Aravis.GvStreamOption.PACKET_SOCKET_DISABLED)
    stream = camera.create_stream(None, None)
    for _ in range(300):
        stream.push_buffer(Aravis.Buffer.new_allocate(camera.get_payload()))
    camera.start_acquisition()
    end_s, seen, bad = time.monotonic() + PATIENCE_S, 0, 0
    with open(out, "wb") as file:
        while seen < octets and time.monotonic() < end_s:
            buffer = stream.timeout_pop_buffer(200_000)
            if buffer is None:
                continue
            if buffer.get_status() == Aravis.BufferStatus.SUCCESS:
                seen += file.write(buffer.get_data())
            else:
                bad += 1
            stream.push_buffer(buffer)
    camera.stop_acquisition()
    resent = stream.get_info_uint64_by_name("n_resent_packets")
    print(json.dumps({**told, "octets": seen, "bad": bad, "resent": resent}))


main()
