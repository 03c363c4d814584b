"""The command line in the process of the tests, asked for its JSON."""

import json

import pytest

from emulator.cli.app import _main


@pytest.fixture
def json_of(capsys):
    """Run a command that ends with an exit code; return the JSON object that it prints last."""

    def run(code, *arguments):
        got = _main([*map(str, arguments), "--json"])
        told = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert got == code, told
        return told

    return run
