"""viva-genicam searches for a GigE Vision camera and reads it: viva_gige.py OCTETS OUT; what it saw, as JSON."""

import json
import sys
import threading
import time

import viva_genicam as viva

PATIENCE_S = 120.0
EVENT_NOTIFICATION, WITH_DATA = 0x1030_0028, 2
ACTION_KEYS = {0x090C: 1, 0x9800: 2, 0x9804: 4}  # registers of the device key, the group key and the group mask


def hear_of_an_edge(camera, address, told):
    """Have the camera's trigger input pulsed by an action command; note what the camera tells of it."""
    for register, key in ACTION_KEYS.items():
        camera.write_register(register, key.to_bytes(4, "big"))
    with camera.events(["Line0AnyEdge"]) as events:
        device_key, group_key, mask = ACTION_KEYS.values()
        acks = viva.send_action(device_key, group_key, mask, destination=address, timeout_ms=2000).acks
        event = events.next_event(20_000)
        camera.write_register(EVENT_NOTIFICATION, WITH_DATA.to_bytes(4, "big"))
        viva.send_action(device_key, group_key, mask, destination=address, timeout_ms=2000)
        with_data = events.next_event(20_000)
    told.update(acks=acks, event=event.id, event_ns=event.ts_dev)
    told.update(data=bytes(event.data).hex(), second=with_data.id, second_data=bytes(with_data.data).hex())


def main():
    octets, out = int(sys.argv[1]), sys.argv[2]
    found = viva.discover(2000, None, True)
    camera = viva.connect_gige(found[0])
    camera.set("BiasEventThresholdPositive", "12")
    told = {"found": [one.ip for one in found], "bias": camera.get("BiasEventThresholdPositive")}
    stream = camera.stream(packet_size=1400)
    camera.acquisition_start()
    end_s, seen, incomplete, name, edge = time.monotonic() + PATIENCE_S, 0, 0, "", {}
    hearing = threading.Thread(target=hear_of_an_edge, args=(camera, found[0].ip, edge), daemon=True)
    with open(out, "wb") as file:
        while (seen < octets or hearing.is_alive()) and time.monotonic() < end_s:
            try:
                frame = stream.next_frame(timeout_ms=500)
            except viva.GenicamError:
                continue
            if frame is not None:
                incomplete += not frame.is_complete
                name = frame.pixel_format
                seen += file.write(bytes(frame.payload()))
                if hearing.ident is None:
                    hearing.start()
    lost = stream.stats().frames_lost
    stream.close()
    camera.close()
    print(
        json.dumps({**told, "edge": edge, "octets": seen, "incomplete": incomplete, "lost": lost, "format": str(name)})
    )


main()
