"""What the library promises to a build: strict C99, no library under it, no division, small; and the page's example."""

import re
from pathlib import Path

import pytest

from firmware_protocol.c import FOLDER, sources
from tests.firmware_protocol.c.board import BOARD, CORTEX_M3, build_firmware
from tests.firmware_protocol.c.toolchain import STRICT, compiler, run

PAGE = Path(__file__).parents[3] / "docs/firmware.md"
ALLOWED = {"memset", "memcpy", "memmove", "memcmp"}  # what GCC expects even of a freestanding world


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    """The library for a Cortex-M3, as object files."""
    folder, gcc, found = tmp_path_factory.mktemp("arm"), compiler("arm-none-eabi-gcc"), []
    for source in sources():
        found.append(folder / f"{source.stem}.o")
        run(gcc, *STRICT, *CORTEX_M3, "-c", source, "-o", found[-1])
    return found


@pytest.mark.arm
def test_it_needs_no_library_and_keeps_no_state(objects):
    symbols = [line.split()[-2:] for line in run("arm-none-eabi-nm", *objects).splitlines() if line.startswith(" ")]
    undefined = {name for kind, name in symbols if kind == "U"}
    assert {name for name in undefined if not name.startswith("evstim_")} <= ALLOWED
    written = [line for line in run("arm-none-eabi-nm", *objects).splitlines() if re.search(r" [BbDdC] ", line)]
    assert written == []


@pytest.mark.arm
def test_it_neither_divides_nor_floats(objects):
    listing = run("arm-none-eabi-objdump", "-d", *objects)
    assert re.search(r"\tumull\t", listing)  # the listing shows what we look for
    assert not re.search(r"\t[us]div|\tv(add|mul|div|cvt|mov|ldr|str)", listing)


@pytest.mark.arm
def test_it_is_as_small_as_the_page_says(objects, tmp_path):
    library = sum(int(line.split()[0]) for line in run("arm-none-eabi-size", *objects).splitlines()[1:])
    text, data, bss = map(int, run("arm-none-eabi-size", build_firmware(tmp_path)).splitlines()[1].split()[:3])
    page = PAGE.read_text()
    told = [int(n) for n in re.findall(r"(\d+) bytes of (?:flash|RAM) \[measured\]", page)]
    assert len(told) == 3
    for measured, said in zip((library, text + data, data + bss), told, strict=True):
        assert abs(measured - said) <= said // 20


def examples():
    return re.findall(r"```c\n(.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.mark.parametrize("index", range(len(examples())))
def test_the_examples_of_the_page_compile(tmp_path, index):
    source = tmp_path / "example.c"
    source.write_text(examples()[index])
    run(compiler("gcc"), *STRICT, "-I", FOLDER, "-c", source, "-o", tmp_path / "example.o")


def test_it_compiles_without_the_compilers_builtins(tmp_path):
    for source in sources():
        run(compiler("gcc"), *STRICT, "-O3", "-DEVSTIM_NO_CLZ", "-c", source, "-o", tmp_path / "without.o")


def test_the_boards_files_are_shipped_with_the_library():
    assert {path.name for path in BOARD.iterdir()} == {"board.h", "board.ld", "main.c", "startup.c"}
