"""Kernels have the same bits on every processor: sums of products are fused by rule, not by the compiler's choice."""

import os
import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
from llvmlite.binding import get_host_cpu_features
from numba import njit
from numba.extending import overload

from firmware_protocol.compiled import KernelCompiler, _EntryCompiler
from tests.test_kernel_sources import kernels, name_of

RIGS = """
import dataclasses, hashlib
import numpy as np
import evstim
from emulator.rig.loading import load_rig
from emulator.sensor.sensor import Sensor

expose = Sensor.expose

def exposed(sensor, frame):
    digests["light"].update(frame.light)
    digests["rate"].update(np.float32(0) if frame.rate is None else frame.rate)
    return expose(sensor, frame)

Sensor.expose = exposed
for name in (
    "checkerboard", "eros", "eros-flyover", "itokawa-gige", "malapert", "rendezvous", "stars", "stars-evk4",
    "stars-dvxplorer", "stars-davis240c", "stars-genx320", "stars-limit-gen3", "stars-silkyevcam-vga",
):
    rig = dataclasses.replace(load_rig(name), links=())
    sensor = rig.camera.sensor
    quiet = dataclasses.replace(sensor, noise=dataclasses.replace(sensor.noise, rms=0.0))
    for parameters in (sensor, quiet):
        digests = {part: hashlib.sha256() for part in ("light", "rate", "events")}
        rig = dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=parameters))
        with evstim.run(rig, seconds=max(0.03, 4e-6 * rig.run.step_us), pace="free") as run:
            for events in run:
                digests["events"].update(events.tobytes())
        for part, digest in digests.items():
            print(name, parameters.noise.rms, part, digest.hexdigest())
"""


@pytest.mark.long
@pytest.mark.anew
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not get_host_cpu_features().get("avx512f"), reason="code for AVX-512 does not run here")
def test_code_for_two_processors_draws_the_same_light_and_has_the_same_events(tmp_path):
    printed = []
    for target in ("x86-64-v3", "x86-64-v4"):
        settings = {"NUMBA_CPU_NAME": target, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path / target)}
        done = subprocess.run([sys.executable, "-c", RIGS], env=os.environ | settings, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        printed.append(done.stdout.splitlines())
    assert len(printed[0]) == 3 * 26
    assert [line for line in printed[0] if line not in printed[1]] == []
    assert printed[0] == printed[1]


def test_no_kernel_leaves_roundings_to_the_compiler():
    """Of all permissions of fastmath there is one, to fuse, and each function that has it is compiled by the rule."""
    free = {name_of(one): one for one in kernels() if one.targetoptions.get("fastmath")}
    assert len(free) > 100
    assert {name for name, one in free.items() if set(one.targetoptions["fastmath"]) != {"contract"}} == set()
    assert {name for name, one in free.items() if not issubclass(one._compiler.pipeline_class, KernelCompiler)} == set()


def exact(value):
    return np.float32(float(value))  # of Fractions here, which float64 holds


A, B, C, D = (np.float32(x) for x in (1 + 2**-12, 1 + 2**-11, -1.0, 1 + 2**-13))
a, b, c, d = map(Fraction, map(float, (A, B, C, D)))


def left(a, b, c, d):
    return a * b + c * d


def right_of_difference(a, b, c, d):
    return c - a * b


def difference(a, b, c, d):
    return a * b - d


def across_a_choice(a, b, c, d):
    product = a * b
    other = c if a > b else d
    return other + product


def used_twice(a, b, c, d):
    product = a * b
    return (product + c) * product


def plain(a, b, c, d):
    return a + b - c


def product_and_sum(a, b, c):
    return a * b + c


@overload(product_and_sum)
def _(a, b, c):
    return product_and_sum


def calls(callee):
    def caller(a, b, c):
        return callee(a, b, c)

    return caller


RULED = {"error_model": "numpy", "pipeline_class": KernelCompiler}


@pytest.mark.parametrize("is_overload", [False, True])
@pytest.mark.parametrize("first", [{}, {"fastmath": {"contract"}}])
def test_a_callee_does_not_inherit_the_permission_of_its_first_caller(first, is_overload):
    callee = product_and_sum if is_overload else njit(error_model="numpy")(product_and_sum)
    results = [njit(**RULED, **options)(calls(callee))(A, A, C) for options in (first, {"fastmath": {"contract"}})]
    assert results == [A * A + C] * 2
    assert exact(a * a + c) != A * A + C


def test_no_entry_keeps_a_permission_of_the_functions_in_it():
    """numba's function for a sum is compiled in the context of its caller."""

    def mean(values):
        return np.hypot(values.mean(), values.std() * values[0] + values[1])

    compiled = njit(fastmath={"contract"}, error_model="numpy", pipeline_class=_EntryCompiler)(mean)
    compiled(np.arange(4.0))
    assert " contract " not in "".join(compiled.inspect_llvm().values())


@pytest.mark.parametrize(
    ("function", "result", "is_fused"),
    [
        (left, exact(a * b + Fraction(float(C * D))), True),
        (right_of_difference, exact(c - a * b), True),
        (difference, exact(a * b - d), True),
        (across_a_choice, exact(d + a * b), True),
        (used_twice, (A * B + C) * (A * B), False),
        (plain, A + B - C, False),
    ],
)
def test_a_sum_of_a_product_is_rounded_once_by_rule(function, result, is_fused):
    compiled = njit(fastmath={"contract"}, error_model="numpy", pipeline_class=KernelCompiler)(function)
    assert compiled(A, B, C, D) == result
    (code,) = compiled.inspect_llvm().values()
    assert " contract " not in code
    assert ("call float @llvm.fma.f32(" in code) == is_fused
