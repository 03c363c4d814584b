"""The firmware, built for the Cortex-M3 board and running in QEMU."""

import socket
import subprocess
import time

from firmware_protocol.c import FOLDER, sources
from tests.firmware_protocol.c.toolchain import STRICT, compiler, run

BOARD = FOLDER / "mps2_an385"
CORTEX_M3 = ["-mcpu=cortex-m3", "-mthumb", "-Os", "-ffunction-sections"]


def build_firmware(folder, *flags):
    """Compile and link without any library; return the ELF file."""
    gcc, program = compiler("arm-none-eabi-gcc"), folder / "firmware.elf"
    link = ["-nostdlib", "-Wl,--gc-sections", "-Wl,--fatal-warnings", "-T", BOARD / "board.ld"]
    files = [*sources(), *sorted(BOARD.glob("*.c"))]
    run(gcc, *STRICT, *CORTEX_M3, *flags, *link, "-I", FOLDER, *files, "-o", program)
    return program


class Board:
    """A running board. `port` is its serial line, on the loopback interface; QEMU listens there."""

    def __init__(self, program, *options):
        qemu = compiler("qemu-system-arm")
        with socket.create_server(("127.0.0.1", 0)) as listener:
            self.port = listener.getsockname()[1]
            self._process = subprocess.Popen(
                [
                    qemu, "-M", "mps2-an385", "-display", "none", "-nodefaults", "-nic", "none",
                    "-kernel", program, *options,
                    "-chardev", f"socket,id=line,fd={listener.fileno()},server=on,wait=off", "-serial", "chardev:line",
                    "-chardev", "stdio,id=console,signal=off", "-serial", "chardev:console",
                ],
                pass_fds=[listener.fileno()], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            )  # fmt: skip

    def ask(self, letter="?"):
        """Send a letter on the console; return what the firmware tells."""
        self._process.stdin.write(letter.encode())
        self._process.stdin.flush()
        line = self._process.stdout.readline().decode()
        return {name: int(value, 16) for name, value in (pair.split("=") for pair in line.split())}

    def wait(self, name, value, seconds=60.0):
        """Ask until a counter has reached a value, or for so long; return what the firmware tells then."""
        deadline = time.monotonic() + seconds
        while (told := self.ask())[name] < value and time.monotonic() < deadline:
            time.sleep(0.05)
        return told

    def feed(self, data):
        """Send bytes on the line; return what the firmware tells when all have come."""
        with socket.create_connection(("127.0.0.1", self.port)) as line:
            line.sendall(data)
            return self.wait("bytes", len(data))

    def close(self):
        """Switch it off."""
        self._process.kill()
        self._process.wait(60)
        self._process.stdin.close()
        self._process.stdout.close()
