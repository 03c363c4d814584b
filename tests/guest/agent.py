"""The guest's process 1, and a process for each driver: runs the commands that the host sends.

    agent.py HOST PORT [MODULE ...]

An agent keeps one idle TCP connection to the host open. The host sends a JSON object and a newline on it:

    {"argv": [...], "timeout_s": 30.0}

and gets back, when the program has ended, {"code": 0, "stdout": "...", "stderr": "..."}; `code` is null when time ran
out. The agent opens the next idle connection as soon as this one is in use, so commands may run side by side.
When the host closes the idle connection the agent ends; with process 1 the guest ends.

A command whose interpreter is the agent's own and whose program is a file runs in a fork of the agent, which has
started the interpreter and imported each MODULE once: that is slow on a processor that QEMU translates. In all else
such a program is a process of its own, from its first line to the end of the interpreter.
"""

import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
from importlib import import_module
from pathlib import Path


def main():
    host, port, *modules = sys.argv[1:]
    for module in modules:
        import_module(module)
    program = serve(host, int(port))
    if program:
        sys.argv, sys.path[0] = program, str(Path(program[0]).parent)
        runpy.run_path(program[0], run_name="__main__")


def serve(host, port):
    """Serve the host until it closes the idle connection; in a fork that shall run a program return its arguments."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for what answers, nor for orphans of process 1
    while True:
        connection = socket.create_connection((host, port))
        request = connection.makefile("rb").readline()
        if not request:
            return []
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            return answer(connection, **json.loads(request))
        connection.close()


def answer(connection, argv, timeout_s):
    """Run the command and send its end to the host, then exit; in the fork that is the program return its arguments."""
    if argv[0] == sys.executable and argv[1].endswith(".py"):
        out, err = os.memfd_create("out"), os.memfd_create("err")
        process = os.fork()
        if process == 0:
            connection.close()
            redirect(out, err)
            return argv[1:]
        finished = {"code": code_of(process, timeout_s), "stdout": content(out), "stderr": content(err)}
    else:
        finished = run(argv, timeout_s)
    connection.sendall(json.dumps(finished).encode() + b"\n")
    connection.close()
    os._exit(0)


def redirect(out, err):
    """Let this process read nothing and write to two files."""
    for source, target in ((os.open(os.devnull, os.O_RDONLY), 0), (out, 1), (err, 2)):
        os.dup2(source, target)
        os.close(source)


def code_of(process, timeout_s):
    """Wait for the end of a child and return its code; None when it had to be killed."""
    ended, _, _ = select.select([os.pidfd_open(process)], [], [], timeout_s)
    if not ended:
        os.kill(process, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    return code if ended else None


def content(file):
    with os.fdopen(file, "rb") as written:
        written.seek(0)
        return text(written.read())


def run(argv, timeout_s):
    try:
        done = subprocess.run(argv, capture_output=True, stdin=subprocess.DEVNULL, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired as error:
        return {"code": None, "stdout": text(error.stdout), "stderr": text(error.stderr)}
    except OSError as error:
        return {"code": 127, "stdout": "", "stderr": str(error)}
    return {"code": done.returncode, "stdout": text(done.stdout), "stderr": text(done.stderr)}


def text(output):
    return (output or b"").decode(errors="replace")


if __name__ == "__main__":
    main()
