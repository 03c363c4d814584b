"""The pytest plugin: rigs and cameras as fixtures. It comes with the package; nothing needs to be switched on.

    @pytest.mark.rig("serial-demo", seed=7)
    def test_the_decoder(evstim_rig):
        port = serial.Serial(evstim_rig.address)

`evstim_rig` starts the rig of the mark on free ports and returns it when its links are open. After the test it stops
the rig and asserts that the ledger balances and no link failed. On a machine that cannot run the rig the test is
skipped with the reason, or fails with `--evstim-require`. After a failed test the rig's last events and its counts are
written into the folder of `--evstim-artefacts`.

`evstim_camera` is a DAVIS346 in memory, without a rig or a link, that pyusb opens: see `evstim.testing.fake_usb`.

Only pytest is imported here: every pytest session of a machine with evstim loads this module.
"""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from evstim.testing.fake_usb import FakeCamera
    from evstim.testing.running_rig import RunningRig

_MARK = "rig(name, seconds=0, seed=None, pace=None, keep_s=2): the rig that the fixture evstim_rig runs"
_failed: pytest.StashKey[bool] = pytest.StashKey()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the plugin."""
    group = parser.getgroup("evstim", "emulated event cameras")
    group.addoption(
        "--evstim-require", action="store_true", help="fail instead of skip on a machine that cannot run a rig"
    )
    group.addoption(
        "--evstim-artefacts",
        type=Path,
        default=Path("evstim-artefacts"),
        help="folder for the events and counts of failed tests (default: evstim-artefacts)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the mark."""
    config.addinivalue_line("markers", _MARK)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Remember whether the test itself failed, for the end of its fixtures."""
    report = yield
    if report.when == "call":
        item.stash[_failed] = report.failed
    return report


@pytest.fixture
def evstim_rig(request: pytest.FixtureRequest, tmp_path: Path) -> Generator[RunningRig]:
    """Run the rig that the test's mark `rig` names."""
    from evstim.testing.running_rig import RunningRig, faults_of_a_run

    mark = request.node.get_closest_marker("rig")
    if mark is None or not mark.args:
        raise pytest.UsageError('evstim_rig needs a mark with a rig: @pytest.mark.rig("loopback")')
    name, beside = mark.args[0], request.node.path.parent / mark.args[0]
    rig = RunningRig(beside if beside.is_file() else name, tmp_path, _options(mark.kwargs))
    _entered(rig, request.config)
    try:
        yield rig
    finally:
        result = rig.stop()
        wrong = faults_of_a_run(result)
        if wrong or request.node.stash.get(_failed, False):
            _write(rig, request.node)
    assert not wrong, "\n".join(wrong)


@pytest.fixture
def evstim_camera() -> Generator[FakeCamera]:
    """Make a DAVIS346 that a test feeds with events and reads as a device of pyusb."""
    from evstim.testing.fake_usb import FakeCamera

    with FakeCamera() as camera:
        yield camera


def _options(keys: dict[str, Any]) -> Any:
    from evstim.testing.running_rig import RigOptions

    try:
        return RigOptions(**keys)
    except TypeError as error:
        raise pytest.UsageError(f"mark rig: {error}; known are seconds, seed, pace, keep_s and ready_s") from error


def _entered(rig: RunningRig, config: pytest.Config) -> None:
    """Start the rig; skip the test, with the reason, on a machine that cannot run it."""
    from emulator.light import MachineLacks
    from emulator.run.link_process import LinkFailed

    try:
        rig.__enter__()
    except (MachineLacks, LinkFailed) as error:
        if config.getoption("evstim_require"):
            raise
        pytest.skip(f"rig {rig.rig.name!r} cannot run on this machine: {error}")


def _write(rig: RunningRig, item: pytest.Item) -> None:
    """Write the rig's events and counts into the artefacts' folder, and name the files in the test's report."""
    from evstim.testing.running_rig import write_artefacts

    base = item.config.invocation_params.dir / item.config.getoption("evstim_artefacts")
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in item.nodeid)[-120:]
    paths = write_artefacts(rig, item.nodeid, base / name)
    item.add_report_section("teardown", "evstim", "\n".join(str(path) for path in paths))
