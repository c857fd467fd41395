"""Other addresses of this machine are noticed once they stay, and zenoh is told them."""

from flocc_agent.config import TransportConfig
from flocc_agent.runtime.addresses import AddressWatch, at_addresses, machine_addresses
from flocc_agent.runtime.zenoh_session import Plane, session_settings

WIFI, CABLE = ("wlan0", "10.0.0.5"), ("eth0", "192.168.1.5")


def test_a_new_address_is_news_once_it_stays() -> None:
    watch = AddressWatch(frozenset({CABLE}))
    assert watch.news(frozenset({CABLE, WIFI})) == ()
    assert watch.news(frozenset({CABLE, WIFI})) == ("10.0.0.5",)
    assert watch.news(frozenset({CABLE, WIFI})) == ()


def test_an_address_that_goes_and_comes_back_is_no_news() -> None:
    watch = AddressWatch(frozenset({CABLE}))
    assert [watch.news(now) for now in (frozenset(), frozenset(), frozenset({CABLE}), frozenset({CABLE}))] == [()] * 4


def test_only_the_interface_that_is_named_matters() -> None:
    watch = AddressWatch(frozenset({WIFI}), "wlan0")
    both = frozenset({WIFI, CABLE})
    assert [watch.news(both), watch.news(both)] == [(), ()]


def test_zenoh_is_told_addresses_in_place_of_all_and_of_names() -> None:
    config = TransportConfig(control_listen=("tcp/0.0.0.0:7450", "tcp/10.0.0.9:1"), interface="wlan0")
    told = at_addresses(session_settings(config, "yard", "r1", Plane.CONTROL), frozenset({WIFI, CABLE}))
    assert told["scouting/multicast/interface"] == "10.0.0.5"
    assert told["listen/endpoints"] == ["tcp/10.0.0.5:7450", "tcp/192.168.1.5:7450", "tcp/10.0.0.9:1"]


def test_no_address_of_the_machine_itself_counts() -> None:
    assert not [address for _, address in machine_addresses() if address.startswith(("127.", "fe80"))]
