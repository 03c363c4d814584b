"""The contract of links over topics of ROS 2, read by CycloneDDS in another process, rosbags and evt3."""

import pytest

pytest.importorskip("cyclonedds", reason="the `ros2` extra is not installed")

from evstim.testing.link_contract import LinkContract
from tests.transports.ros2.ros_readers import DOMAIN, EventReader, own_topic
from transports.ros2.kind import Ros2Link

pytestmark = [pytest.mark.system, pytest.mark.socket]


@pytest.mark.long
class TestEvt3(LinkContract):
    parameters = Ros2Link(topic=own_topic(), domain=DOMAIN)

    def reader(self, link):
        return EventReader(link, self.parameters.topic)


class TestMono(TestEvt3):
    parameters = Ros2Link(topic=own_topic(), domain=DOMAIN, encoding="mono", image_topic=own_topic("images"))
    many = 20_000
