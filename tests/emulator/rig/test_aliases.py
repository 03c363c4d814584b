"""Old spellings and removed keys in rig files: they load as the new ones with a warning, or are refused."""

import logging

import pytest

from emulator.rig.loading import REMOVED, VALUES, RigError, load_rig, parse_rig

RIG = '[scene]\nkind = "checkerboard"\n[run]\nmethod = "{}"\n'
RENAMED = VALUES["run", "method"]


def loaded(method):
    return parse_rig(RIG.format(method), "a.toml", "a")


def test_the_old_spellings_are_known():
    assert RENAMED == {"warped": "hermite", "held": "v2e_exact_filter"}


@pytest.mark.parametrize("old", ["warped", "held"])
def test_an_old_spelling_gives_the_same_rig_and_a_warning(old, caplog):
    with caplog.at_level(logging.WARNING):
        assert loaded(old) == loaded(RENAMED[old])
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert f"run.method = '{old}' is the old spelling of '{RENAMED[old]}'" in record.getMessage()


def test_new_spellings_give_no_warning(caplog):
    assert loaded("hermite").run.method == "hermite"
    assert loaded("v2e_exact_filter").run.method == "v2e_exact_filter"
    assert load_rig("checkerboard").run.method == "hermite"
    assert not caplog.records


@pytest.mark.parametrize("text", ['"heldd"', "3", '["warped"]', "{ warped = 1 }"])
def test_other_values_are_refused_as_before(text, caplog):
    with pytest.raises(RigError, match="method"):
        parse_rig(f'[scene]\nkind = "checkerboard"\n[run]\nmethod = {text}\n', "a.toml", "a")
    assert not caplog.records


@pytest.mark.parametrize("run", ["run = 3", "run = []", 'run = "warped"'])
def test_a_run_that_is_no_table_is_refused_as_before(run):
    with pytest.raises(RigError, match="expected a table"):
        parse_rig(f'{run}\n[scene]\nkind = "checkerboard"\n', "a.toml", "a")


def test_pixels_on_the_cpu_load_with_a_warning(caplog):
    text = '[scene]\nkind = "checkerboard"\n[run]\npixels = "cpu"\nseed = 7\n'
    with caplog.at_level(logging.WARNING):
        assert parse_rig(text, "a.toml", "a") == parse_rig(text.replace('pixels = "cpu"\n', ""), "a.toml", "a")
    (record,) = caplog.records
    assert "run.pixels has no effect" in record.getMessage()


@pytest.mark.parametrize("value", ['"gpu"', "3", '["cpu"]'])
def test_pixels_elsewhere_are_refused(value):
    with pytest.raises(RigError, match=r"a\.toml, line 4: run\.pixels: .*the CPU solves the pixels of every rig"):
        parse_rig(f'[scene]\nkind = "checkerboard"\n[run]\npixels = {value}\n', "a.toml", "a")


def tables_of(path, value):
    *names, key = path
    return f'[scene]\nkind = "checkerboard"\n[{".".join(names)}]\n{key} = {value}\n'


@pytest.mark.parametrize("path", [path for path in REMOVED if path[0] == "camera"], ids=".".join)
def test_a_removed_key_with_its_lasting_value_loads_with_a_warning_and_is_refused_with_another(path, caplog):
    with caplog.at_level(logging.WARNING):
        rig = parse_rig(tables_of(path, REMOVED[path].value), "a.toml", "a")
    assert rig == parse_rig(tables_of(path, REMOVED[path].value).rpartition(f"{path[-1]} =")[0], "a.toml", "a")
    (record,) = caplog.records
    assert record.getMessage().startswith(f"{'.'.join(path)} has no effect: ")
    with pytest.raises(RigError, match=rf"a\.toml, line 4: {'.'.join(path)}: 7 is not available: "):
        parse_rig(tables_of(path, 7), "a.toml", "a")
