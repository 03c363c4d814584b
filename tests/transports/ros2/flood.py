"""A program that floods a domain of DDS: participants that come and go, readers that take nothing, and datagrams.

    python flood.py DOMAIN TOPIC ROUNDS

Each round joins the domain with eight participants, each with a reader of the topic that takes nothing and a writer of
it that writes nothing, and leaves. Then datagrams of random bytes, and such that begin as those of DDS do, go to the
domain's ports. "round N" is printed after each. It imports nothing of evstim.
"""

import random
import socket
import sys

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from peer import CONFIGURATION, EventPacket

PARTICIPANTS, DATAGRAMS = 8, 2000
PORTS = 32 * 2 + 12  # of a domain: two for each process, from 10 on


def crowd(domain, topic):
    """Join the domain; returned is what leaves when it is forgotten."""
    participants = [DomainParticipant(domain) for _ in range(PARTICIPANTS)]
    reliable = Qos(
        Policy.Reliability.Reliable(max_blocking_time=0),
        Policy.History.KeepLast(1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    topics = [Topic(one, f"rt{topic}", EventPacket) for one in participants]
    ends = [kind(one, at, qos=reliable) for kind in (DataReader, DataWriter)
            for one, at in zip(participants, topics, strict=True)]  # fmt: skip
    return participants, topics, ends


def datagrams(domain, rng):
    """Send random bytes, and heads of RTPS with random bytes behind them, to all ports of the domain."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k in range(DATAGRAMS):
            head = (b"", b"RTPS\x02\x01\x01\x10" + rng.randbytes(12))[k % 2]
            to = "127.0.0.1", 7400 + 250 * domain + k % PORTS
            sender.sendto(head + rng.randbytes(rng.randrange(1, 512)), to)


def main():
    domain, topic, rounds = int(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    rng = random.Random(7)
    _config = Domain(domain, CONFIGURATION)
    for number in range(rounds):
        joined = crowd(domain, topic)
        datagrams(domain, rng)
        del joined
        sys.stdout.write(f"round {number}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
