"""Times that functions take are whole numbers in the unit of their names: nothing else is used, nor rounded."""

import inspect
import types

import numpy as np
import pytest

import evstim
from evstim import representations

EVENTS = np.zeros(3, evstim.EVENT)
FRAMES = np.full((2, 3, 4), 0.5)
SIZE = (4, 3)


def simulated(us):
    rig = evstim.Rig("a", "b", evstim.CheckerboardScene())
    with evstim.Simulation(rig) as sim:
        return sim.step(us)


CALLS = {
    "Simulation.step us": simulated,
    "events_from_frames step_us": lambda us: evstim.events_from_frames(FRAMES, [0, 1000], step_us=us),
    "events_from_frames t_us": lambda us: evstim.events_from_frames(FRAMES, [0, us]),
    "events_from_video step_us": lambda us: evstim.events_from_video("none.npy", step_us=us),
    "reconstruct t_us": lambda us: evstim.reconstruct(
        EVENTS, np.zeros((3, 4)), threshold_on=0.1, threshold_off=0.1, t_us=us
    ),
    "representations.time_surface t_us": lambda us: representations.time_surface(EVENTS, SIZE, 100.0, us),
    "representations.time_surface tau_us": lambda us: representations.time_surface(EVENTS, SIZE, us),
    "representations.voxel_grid begin_us": lambda us: representations.voxel_grid(EVENTS, SIZE, 2, begin_us=us),
    "representations.voxel_grid end_us": lambda us: representations.voxel_grid(EVENTS, SIZE, 2, end_us=us),
}
NO_TIME_OF_A_CALL = {"CanLink.raw tick_us"}


def taken():
    """Yield each parameter in microseconds of a public function or method; fields of classes have bounds."""
    for name in evstim.__all__:
        value = getattr(evstim, name)
        members = vars(value) if isinstance(value, type | types.ModuleType) else {}
        for place, function in {name: value, **{f"{name}.{key}": member for key, member in members.items()}}.items():
            if inspect.isfunction(function) and not place.split(".")[-1].startswith("_"):
                for parameter in inspect.signature(function).parameters:
                    if parameter == "us" or parameter.endswith("_us"):
                        yield f"{place} {parameter}"


def test_each_function_is_here():
    assert {*taken()} - NO_TIME_OF_A_CALL == set(CALLS)


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("us", [0.02, True, "20"])
def test_seconds_and_words_are_refused(call, us):
    if (call, us) == ("events_from_frames t_us", 0.02):
        with (
            pytest.warns(DeprecationWarning, match="whole microseconds"),
            pytest.raises(ValueError, match="are in microseconds"),
        ):
            CALLS[call](us)
        return
    if (call, us) == ("events_from_frames t_us", True):
        pytest.skip("[0, True] is an array of whole numbers")
    with pytest.raises((TypeError, ValueError), match=r"microseconds|not supported"):
        CALLS[call](us)


@pytest.mark.parametrize("call", [call for call in CALLS if not call.endswith("tau_us")])
def test_nanoseconds_are_refused(call):
    with pytest.raises(ValueError, match=r"if it is in nanoseconds, divide it by 1000"):
        CALLS[call](10**18)


@pytest.mark.parametrize("us", [1000, np.int64(1000), np.uint16(1000), np.array(1000)])
def test_numbers_of_numpy_are_the_same(us):
    assert simulated(us).t_us == 1000
    for call in ("events_from_frames step_us", "reconstruct t_us", "representations.voxel_grid end_us"):
        np.testing.assert_array_equal(CALLS[call](us), CALLS[call](1000))


@pytest.mark.parametrize("wrong", [1.5, True, 0.02, "3"])
@pytest.mark.parametrize("table", [evstim.RunParameters, evstim.ImagerParameters, evstim.Trigger])
def test_whole_numbers_of_tables(table, wrong):
    key = {"Run": "step_us", "ImagerParameters": "shot_grid_us", "Trigger": "pulse_us"}[table.__name__]
    with pytest.raises(ValueError, match=f"{key} must be a whole number, got"):
        table(**{key: wrong})
