"""The keywords, run by Robot Framework itself."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.system

pytest.importorskip("robot", reason="Robot Framework is not installed (extra test)")

HEAD = """
*** Settings ***
Library    evstim.testing.robot_keywords.RobotKeywords

*** Test Cases ***
"""


@pytest.fixture
def robot(tmp_path):
    def run(cases):
        (tmp_path / "cases.robot").write_text(HEAD + cases)
        quiet = ["--output", "NONE", "--log", "NONE", "--report", "NONE"]
        command = [sys.executable, "-m", "robot", *quiet, "cases.robot"]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, env=environment)

    return run


@pytest.mark.long
def test_a_rig_is_started_hurt_and_stopped(robot):
    done = robot("""
The Camera Sends Events
    ${address} =    Start Rig    serial-demo    seed=7
    Should Contain    ${address}    .tty
    Inject Fault    bit_flips    rate=1e-4    for_s=0.2
    Wait Until Keyword Succeeds    60s    100ms    Events Have Come
    ${result} =    Stop Rig
    Should Be True    ${result.ledger.balanced}

A Rig That Is Left Running Is Stopped
    Start Rig    loopback

And The Next Case Starts Its Own
    Start Rig    loopback    pace=free    seconds=0.05
    Stop Rig

*** Keywords ***
Events Have Come
    ${n} =    Events Read Out
    Should Be True    ${n} > 0
""")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 tests, 3 passed" in done.stdout


def test_wrong_use_fails_with_what_to_do(robot):
    done = robot("""
Stop Without Start
    Stop Rig
""")
    assert done.returncode == 1
    assert "use Start Rig first" in done.stdout
