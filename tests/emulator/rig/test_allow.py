"""A rig that other machines can reach says who may connect, or is refused."""

import pytest

from emulator.rig.loading import RigError, parse_rig
from emulator.run.assembly import link_setups

SCENE = '[scene]\nkind = "checkerboard"\nsquare_px = 40.0\nspeed_px_s = 3.0\n'
LINKS = {
    "usbip": '[[links]]\nkind = "usbip"\n',
    "can": '[[links]]\nkind = "can"\n[links.instrument]\nregion = [0, 0, 64, 64]\n',
}


def rig(kind, keys):
    return parse_rig(SCENE + LINKS[kind].replace(f'"{kind}"\n', f'"{kind}"\n{keys}\n'), "bench.toml", "bench")


@pytest.mark.parametrize("kind", LINKS)
@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", ""])
def test_a_link_beyond_loopback_without_a_list_is_refused_at_its_line(kind, host):
    with pytest.raises(RigError, match=r"bench.toml, line 7: links\[0\].host: .*set allow, for example"):
        rig(kind, f'host = "{host}"')


@pytest.mark.parametrize("kind", LINKS)
def test_the_list_reaches_the_link(kind):
    (setup,) = link_setups(rig(kind, 'host = "192.168.1.7"\nallow = ["10.0.0.5", "192.168.1.0/24"]'))
    assert setup.endpoint.link.allow == ("10.0.0.5", "192.168.1.0/24")


@pytest.mark.parametrize("kind", LINKS)
def test_an_entry_that_is_no_address_is_refused_at_its_line(kind):
    with pytest.raises(RigError, match=r"line 7: links\[0\].allow: .*'bench' is neither an address nor a network"):
        rig(kind, 'allow = ["bench"]')
