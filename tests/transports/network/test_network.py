"""Who may connect, and who keeps a place: lists of addresses and the admission of connections."""

import ipaddress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from transports.can_bus.kind import CanLink
from transports.connections import Admission, Places
from transports.network import AllowList, check_allow, is_loopback
from transports.usb.kind import UsbipLink


@pytest.mark.parametrize(
    ("entries", "address", "permitted"),
    [
        ((), "127.0.0.1", True),
        ((), "127.9.9.9", True),
        ((), "::1", True),
        ((), "::ffff:127.0.0.1", True),
        ((), "192.168.1.4", False),
        (("10.0.0.5",), "10.0.0.5", True),
        (("10.0.0.5",), "10.0.0.6", False),
        (("10.0.0.5",), "127.0.0.1", False),
        (("10.0.0.5", "192.168.1.0/24"), "192.168.1.255", True),
        (("10.0.0.5", "192.168.1.0/24"), "192.168.2.0", False),
        (("192.168.1.0/24",), "::ffff:192.168.1.7", True),
        (("fe80::/10",), "fe80::1%eth0", True),
        (("0.0.0.0/0",), "::1", False),
        (("0.0.0.0/0",), "no address", False),
    ],
)
def test_who_is_permitted(entries, address, permitted):
    assert AllowList(entries).permits(address) is permitted


@given(st.ip_addresses(v=4), st.integers(0, 32), st.ip_addresses(v=4))
def test_a_network_permits_the_addresses_with_its_prefix(base, bits, peer):
    shift = 32 - bits
    network = f"{ipaddress.IPv4Address(int(base) >> shift << shift)}/{bits}"
    assert AllowList([network]).permits(str(peer)) is (int(base) >> shift == int(peer) >> shift)


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "::", "", "192.168.1.7", "bench.example", "fe80::1%eth0", "::ffff:10.0.0.1"]
)
def test_a_host_that_others_reach_needs_a_list(host):
    assert not is_loopback(host)
    with pytest.raises(ValueError, match="set allow, for example"):
        check_allow(host, ())
    check_allow(host, ["10.0.0.5"])


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_a_loopback_host_needs_none(host):
    check_allow(host, ())


@pytest.mark.parametrize("entry", ["everybody", "192.168.1.7/24", "10.0.0.256", "", "10.0.0.0/33"])
def test_an_entry_that_is_no_address_is_named(entry):
    with pytest.raises(ValueError, match=r"^allow: .*neither an address nor a network"):
        check_allow("127.0.0.1", [entry])


@pytest.mark.parametrize("link", [UsbipLink, CanLink])
def test_every_link_that_listens_checks_its_host(link):
    with pytest.raises(ValueError, match=r"^host '0\.0\.0\.0' can be reached"):
        link(host="0.0.0.0")
    assert link(host="0.0.0.0", allow=("10.0.0.0/8",)).allow == ("10.0.0.0/8",)
    assert CanLink(interface="socketcand", host="10.0.0.1").host == "10.0.0.1"  # joins, and does not listen


class Visits:
    """Connections of an admission, by the names that the test gives them."""

    def __init__(self, total, per_address):
        self.admission = Admission(AllowList(["0.0.0.0/0"]), Places(total, per_address))
        self.seats = {}
        self.evicted = []

    def come(self, name, address):
        seat = self.admission.admit(address, lambda: self.evicted.append(name))
        if seat is not None:
            self.seats[name] = seat
        return seat is not None


def test_the_oldest_idle_one_of_the_same_address_makes_way_first():
    visits = Visits(total=10, per_address=2)
    assert all(visits.come(name, address) for name, address in [("b", "2"), ("a1", "1"), ("a2", "1"), ("a3", "1")])
    assert visits.evicted == ["a1"]
    visits.admission.settle(visits.seats["a2"])
    visits.admission.settle(visits.seats["a3"])
    assert not visits.come("a4", "1")
    assert visits.evicted == ["a1"]


def test_the_address_with_the_most_idle_ones_makes_way():
    visits = Visits(total=4, per_address=3)
    for name, address in [("b1", "2"), ("a1", "1"), ("a2", "1"), ("a3", "1"), ("c1", "3")]:
        assert visits.come(name, address)
    assert visits.evicted == ["a1"]


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 3), st.integers(0, 50)), max_size=200))
def test_bounds_hold_and_settled_ones_stay(steps):
    visits = Visits(total=6, per_address=3)
    settled = set()
    for n, (address, what, which) in enumerate(steps):
        living = [name for name in visits.seats if name not in visits.evicted]
        if what < 2 or not living:
            visits.come((address, n), str(address))
        elif what == 2:
            name = living[which % len(living)]
            visits.admission.settle(visits.seats[name])
            settled.add(name)
        else:
            name = living[which % len(living)]
            visits.admission.leave(visits.seats.pop(name))
            settled.discard(name)
        living = [name for name in visits.seats if name not in visits.evicted]
        assert len(visits.admission) == len(living) <= 6
        assert all(sum(name[0] == one for name in living) <= 3 for one in range(5))
        assert not settled & set(visits.evicted)
