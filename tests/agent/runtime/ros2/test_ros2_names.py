"""rmw_zenoh's names: those of its design document, and type hashes as REP 2016 defines them."""

import pytest
from tests.agent.runtime.ros2 import cdr_by_hand

from flocc_agent.runtime.ros2.topics import EntityRole, Node, Offer, Qos, Topic, attachment, full_name, read_offer
from flocc_agent.runtime.ros2.types import MessageTypes, gid_of

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = Topic("/chatter", "std_msgs/msg/String", STRING_HASH, Qos(10))
TALKER = Node(2, "aac3178e146ba6f1fc6e6a4085e77f21", "", "talker")
CHATTER_TOKEN = (
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
    f"{STRING_HASH}/::,10:,:,:,,"
)


def test_the_names_of_the_design_document() -> None:
    assert CHATTER.key(0) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert TALKER.token() == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/talker"
    assert TALKER.endpoint_token(10, EntityRole.PUBLISHES, CHATTER) == CHATTER_TOKEN


def test_names_within_a_namespace() -> None:
    node = Node(7, "ab", "/r1", "flocc_r1")
    odom = Topic(full_name("/r1", "odom"), "nav_msgs/msg/Odometry", "RIHS01_x", Qos(5, best_effort=True))
    assert odom.key(7) == "7/r1/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_x"
    assert node.endpoint_token(3, EntityRole.SUBSCRIBES, odom) == (
        "@ros2_lv/7/ab/0/3/MS/%/%r1/flocc_r1/%r1%odom/nav_msgs::msg::dds_::Odometry_/RIHS01_x/2::,5:,:,:,,"
    )
    assert full_name("/r1", "/tf") == "/tf"
    assert full_name("", "odom") == "/odom"


@pytest.mark.parametrize(
    ("qos", "told"),
    [
        (Qos(42), "::,:,:,:,,"),
        (Qos(10), "::,10:,:,:,,"),
        (Qos(1, transient_local=True), ":1:,1:,:,:,,"),
        (Qos(10, best_effort=True), "2::,10:,:,:,,"),
    ],
)
def test_qos_tells_only_what_differs_from_the_default(qos: Qos, told: str) -> None:
    assert str(qos) == told


def test_reads_what_a_publisher_offers_and_nothing_else() -> None:
    assert read_offer(CHATTER_TOKEN) == Offer("/talker", "/chatter", "std_msgs/msg/String", STRING_HASH)
    in_namespace = Node(0, "ab", "/r1/front", "driver").endpoint_token(1, EntityRole.PUBLISHES, CHATTER)
    assert read_offer(in_namespace) == Offer("/r1/front/driver", "/chatter", "std_msgs/msg/String", STRING_HASH)
    for other in (TALKER.token(), CHATTER_TOKEN.replace("/MP/", "/MS/"), CHATTER_TOKEN + "/x", "x", ""):
        assert read_offer(other) is None


def test_an_attachment_is_number_time_and_identifier_in_33_bytes() -> None:
    gid = bytes(range(16))
    assert attachment(3, 0x0102030405060708, gid).hex() == "0300000000000000" + "0807060504030201" + "10" + gid.hex()
    assert cdr_by_hand.read_attachment(attachment(3, 5, gid)) == (3, 5, gid)


def test_an_identifier_is_xxh3_128_of_the_token_low_half_first() -> None:
    low, high = 0x6001C324468D497F, 0x99AA06D3014798D8  # XXH3-128 of nothing, as xxHash publishes it
    assert gid_of("") == low.to_bytes(8, "little") + high.to_bytes(8, "little")


@pytest.mark.parametrize("name", sorted(cdr_by_hand.DEFINITIONS))
def test_type_hashes_are_those_of_rep_2016(name: str) -> None:
    assert MessageTypes().hash(name) == cdr_by_hand.type_hash(name)


def test_the_hash_of_string_is_the_one_in_the_design_document() -> None:
    assert MessageTypes().hash("std_msgs/msg/String") == STRING_HASH
