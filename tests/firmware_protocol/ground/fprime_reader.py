"""Run by a Python that has fprime-gds: decodes packets and encodes commands by a dictionary, and tells of it in JSON.

python fprime_reader.py DICTIONARY < {"telemetry": [[name, hex], ...], "commands": [[name, [argument, ...]], ...]}
"""

import json
import struct
import sys

from fprime_gds.common.data_types.cmd_data import CmdData
from fprime_gds.common.decoders.pkt_decoder import PktDecoder
from fprime_gds.common.loaders.ch_json_loader import ChJsonLoader
from fprime_gds.common.loaders.cmd_json_loader import CmdJsonLoader
from fprime_gds.common.loaders.pkt_json_loader import PktJsonLoader

__all__ = []


def main():
    """Read the dictionary, then do what is asked."""
    path, asked = sys.argv[1], json.load(sys.stdin)
    channels = ChJsonLoader(path)
    by_id, by_name = channels.get_id_dict(None), channels.get_name_dict(None)
    packets = PktJsonLoader(path)
    (set_name,) = packets.get_packet_set_names(None)
    templates = packets.get_id_dict(None, set_name, by_name)
    numbers = {one.get_name(): number for number, one in templates.items()}
    decoder = PktDecoder(templates, by_id)
    read = []
    for name, octets in asked["telemetry"]:
        body = bytes.fromhex(octets)
        data = struct.pack(">HHBII", numbers[name], 2, 0, 1, 500_000) + body
        values = decoder.decode_api(data)
        read.append({one.template.get_name(): one.val_obj.val for one in values})
    commands = CmdJsonLoader(path).get_name_dict(None)
    built = []
    for name, arguments in asked["commands"]:
        template = commands[f"evstim.{name}"]
        command = CmdData(arguments, template)
        built.append([template.get_op_code(), b"".join(one.serialize() for one in command.get_args()).hex()])
    told = {"telemetry": read, "commands": built}
    sys.stdout.write(f"RESULT {json.dumps(told)}\n")


main()
