"""`--serve [HOST:PORT]`: the live page of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from emulator.cli.output import LACKING, WRONG_USE, Failure, status
from emulator.light import MachineLacks
from emulator.live_page.address import Address, parse_address
from emulator.rig.loading import Rig
from emulator.run.changes import Operator
from emulator.run.fault_injection import FaultInjection
from emulator.run.outcome import RunStatus
from emulator.run.session import Session
from firmware_protocol.events import Events
from transports.link.edges import EdgeSink
from transports.link.process import LinkSetup

if TYPE_CHECKING:
    from emulator.live_page.page import LivePage

__all__ = ["Serving", "ShownRun", "check_serving"]


class ShownRun:
    """Shows a session on its page; does nothing without one."""

    def __init__(self, session: Session, page: LivePage | None) -> None:
        self._session, self._page = session, page

    def take(self, events: Events) -> None:
        """Show the events of a step."""
        if self._page is not None:
            self._page.show(events, self._session.light, self._session.t_ns // 1000)

    def renew(self, status: RunStatus) -> None:
        """Show how the run stands."""
        if self._page is not None:
            self._page.renew(status)


class Serving:
    """The page that was asked for, or none."""

    def __init__(self, rig: Rig, asked: str | bool | None) -> None:
        self._rig = rig
        self._address = _address(asked)
        self._trigger: EdgeSink | None = None

    def wired(self, setups: Sequence[LinkSetup[Any]]) -> list[LinkSetup[Any]]:
        """Return the links, with their inputs wired to the page's button where nothing else is."""
        if self._address is None or self._rig.trigger is not None:
            return list(setups)
        from emulator.live_page.page import with_trigger_button

        wired, self._trigger = with_trigger_button(setups)
        return wired

    @contextmanager
    def page(self, session: Session) -> Iterator[ShownRun]:
        """Serve the page; raises Failure where it cannot listen there."""
        if self._address is None:
            yield ShownRun(session, None)
            return
        from emulator.live_page.orders import Orders
        from emulator.live_page.page import LivePage

        run = self._rig.run
        can_pause = run.pace == "free" and not run.lockstep_us
        viewer = Operator(session, "live page")
        inject = FaultInjection(self._rig, viewer, None).answer
        orders = Orders(viewer, inject, self._button(viewer), can_pause=can_pause)
        try:
            page = LivePage(self._rig, self._address, orders)
        except OSError as error:
            raise Failure(f"--serve: {_shown(self._address)}: {error.strerror or error}", LACKING) from error
        with page:
            status.print(f"live page: {page.url}", markup=False, soft_wrap=True)
            yield ShownRun(session, page)

    def _button(self, viewer: Operator) -> Callable[[int, int], None] | None:
        """Return the trigger, which records its edges; None where there is none."""
        trigger = self._trigger
        if trigger is None:
            return None

        def press(bus_t_ns: int, number: int) -> None:
            early = trigger.heard_early
            trigger(bus_t_ns, number)
            if trigger.heard_early == early:
                viewer.record(trigger.last_us, "trigger pulse")

        return press


def check_serving(asked: str | bool | None) -> None:
    """Raise Failure where a page is asked for that cannot be."""
    if _address(asked) is None:
        return
    from emulator.live_page.page import check_ui

    try:
        check_ui()
    except MachineLacks as error:
        raise Failure(str(error), LACKING) from error


def _address(asked: str | bool | None) -> Address | None:
    if asked is None or asked is False:
        return None
    try:
        return Address() if asked is True else parse_address(asked)
    except ValueError as error:
        raise Failure(f"--serve: {error}", WRONG_USE) from error


def _shown(address: Address) -> str:
    return f"{address.host}:{address.port}"
