"""The consoles of a command."""

import io

import pytest
from rich.table import Table
from rich.text import Text

from emulator.cli import output


@pytest.mark.parametrize("is_terminal", [True, False])
def test_control_characters_reach_no_terminal(is_terminal):
    """Of a title, of a name in a table or in the log, and of a peer's message."""
    written = io.StringIO()
    console = type(output.console)(file=written, force_terminal=is_terminal, color_system=None)
    table = Table("a \x1b[31mname")
    table.add_row(Text("a cell \x9b31m"))
    for shown in ("a title \x1b]0;x\x1b\\", table):
        console.print(shown, markup=False)
    assert not set(written.getvalue()) & {"\x1b", "\x9b", "\x07"}
    assert "\\x1b[31m" in written.getvalue()
    assert "\\x9" in written.getvalue()
