"""The commands of a page, typed into terminals as a reader types them.

A block of shell code has commands, and so has other text behind "$ "; further lines of text are what they print. A
terminal is bash on a pseudo-terminal, which is read all the time. Its prompt has the exit code of the last command.
"""

import os
import pty
import re
import signal
import subprocess
import threading
from contextlib import suppress

__all__ = ["Terminal", "commands_of", "lines_of", "pattern_of", "without_comment"]

PATIENCE_S = 900  # on a busy machine; nothing here is expected to take a tenth of it
PROMPT = re.compile(r"<exit (\d+)> ")
FENCE = re.compile(r"^```(sh|bash|console|text)\n(.*?)^```", re.MULTILINE | re.DOTALL)
CONTROLS = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]|\r")


def commands_of(page):
    """Return the commands of a page in their order, each a line with its comment."""
    return [line for line, is_printed in lines_of(page) if not is_printed]


def lines_of(page):
    """Yield the lines of a page's blocks in their order: commands, and lines that they print."""
    for kind, block in FENCE.findall(page):
        for line in block.splitlines():
            if not is_command(kind, line):
                yield line, True
            elif (command := line.removeprefix("$ ")) and not command.startswith("#"):
                yield command, False


def is_command(kind, line):
    return kind in ("sh", "bash") or line.startswith("$ ")


def pattern_of(line):
    """Return a pattern for a line that a page shows as printed: any number fits in the place of a number."""
    return re.sub(r"[0-9a-f]*\d[0-9a-f]*", r"[0-9a-f]+", re.escape(line))


def without_comment(line):
    """Return a command, and the comment behind it."""
    command, _, comment = re.sub(r"\s+# ", "\0", line, count=1).partition("\0")
    return command.strip(), comment.strip()


class Terminal:
    """Bash in a folder with an environment."""

    def __init__(self, folder, environment):
        ours, theirs = pty.openpty()
        shell = ["setsid", "--ctty", "bash", "--norc", "--noprofile", "--noediting", "-i"]
        settings = {**environment, "PS1": r"<exit $?> ", "TERM": "xterm", "COLUMNS": "250", "LINES": "50"}
        streams = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
        self._shell = subprocess.Popen(shell, cwd=folder, env=settings, preexec_fn=_end_on_ctrl_c, **streams)
        os.close(theirs)
        self._file, self._raw, self._begun = ours, b"", 0
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.is_idle = True
        self._until(PROMPT)
        self.run("stty -echo")

    def type(self, command):
        """Type a command; it may go on."""
        self._begun, self.is_idle = len(self._raw), False
        os.write(self._file, f"{command}\n".encode())

    def run(self, command):
        """Type a command and wait for its end; return its exit code."""
        self.type(command)
        return self.end()

    def wait_for(self, pattern):
        """Wait until the present command has printed something; it must not end before."""
        match = self._until(re.compile(f"{pattern}|{PROMPT.pattern}"))
        assert match[1] is None, f"ended before {pattern!r}: {self.output}"

    def has_printed(self, pattern, within_s):
        """Return whether it shows a pattern, at the latest after some time."""
        with self._news:
            return self._news.wait_for(lambda: re.search(pattern, self.text), within_s) is not None

    def interrupt(self):
        """Send what Ctrl-C sends, where the program still runs, and wait for its end; return its exit code."""
        group = os.tcgetpgrp(self._file)
        if group != self._shell.pid:
            with suppress(ProcessLookupError):
                os.killpg(group, signal.SIGINT)
        return self.end()

    def end(self):
        """Wait for the end of the present command; return its exit code."""
        code = int(self._until(PROMPT)[1])
        self.is_idle = True
        return code

    @property
    def folder(self):
        """The present working directory."""
        return os.readlink(f"/proc/{self._shell.pid}/cwd")

    @property
    def output(self):
        """The output of the present or last command."""
        return plain(self._raw[self._begun :])

    @property
    def text(self):
        """All output."""
        return plain(self._raw)

    def close(self):
        """End the shell with all that it started."""
        self._shell.send_signal(signal.SIGHUP)
        try:
            self._shell.wait(60)
        except subprocess.TimeoutExpired:
            os.killpg(self._shell.pid, signal.SIGKILL)
            self._shell.wait()
        self._reader.join(60)
        os.close(self._file)

    def _read(self):
        """Read until no program has the terminal any more."""
        with suppress(OSError):
            while data := os.read(self._file, 1 << 16):
                with self._news:
                    self._raw += data
                    self._news.notify()

    def _until(self, pattern):
        with self._news:
            match = self._news.wait_for(lambda: pattern.search(self.output), PATIENCE_S)
            assert match, f"no {pattern.pattern!r} in {self.output}"
            return match


def _end_on_ctrl_c():
    """End on SIGINT: where these tests run in the background of a shell, it is ignored, and so it would be here."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def plain(raw):
    """Return output without colours and movements of the cursor."""
    return CONTROLS.sub("", raw.decode(errors="replace"))
