"""Run by a Python that has openc3: reads packets and builds commands with COSMOS's own code, and tells of it in JSON.

python cosmos_reader.py PLUGIN < {"telemetry": [hex, ...], "commands": [[name, {item: value}], ...]}
"""

import json
import sys
from pathlib import Path

from openc3.interfaces.interface import Interface
from openc3.interfaces.protocols.crc_protocol import CrcProtocol
from openc3.packets.commands import Commands
from openc3.packets.packet_config import PacketConfig
from openc3.packets.telemetry import Telemetry

__all__ = []


def _plain(value):
    return value.hex() if isinstance(value, bytes | bytearray) else value


def _read(telemetry, octets):
    packet = telemetry.identify(octets, ["EVSTIM"]).clone()
    packet.buffer = octets
    items = [item for item in packet.sorted_items if item.data_type != "DERIVED"]
    return {
        "name": packet.packet_name,
        "values": {item.name: _plain(packet.read_item(item)) for item in items},
        "units": {item.name: item.units for item in items if item.units},
    }


def _built(commands, crc, name, values):
    packet = crc.write_packet(commands.build_cmd("EVSTIM", name, values))
    return crc.write_data(packet.buffer, None)[0].hex()


def main():
    """Read the files, then do what is asked."""
    plugin, asked = Path(sys.argv[1]), json.load(sys.stdin)
    config = PacketConfig()
    for name in ("tlm.txt", "cmd.txt"):
        config.process_file(str(plugin / "targets" / "EVSTIM" / "cmd_tlm" / name), "EVSTIM")
    (line,) = (line for line in (plugin / "plugin.txt").read_text().splitlines() if "PROTOCOL" in line)
    crc = CrcProtocol(*line.split()[3:])
    crc.interface = Interface()
    telemetry, commands = Telemetry(config, None), Commands(config, None)
    packets = [bytes.fromhex(octets) for octets in asked["telemetry"]]
    told = {
        "telemetry": [_read(telemetry, octets) for octets in packets],
        "commands": [_built(commands, crc, name, values) for name, values in asked["commands"]],
        "good": [crc.read_data(octets, None)[0] == octets for octets in packets],
        "wrong": [crc.read_data(octets[:-1] + b"!", None)[0] == octets for octets in packets],
    }
    sys.stdout.write(f"RESULT {json.dumps(told)}\n")


main()
