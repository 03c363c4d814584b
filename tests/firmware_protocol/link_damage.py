"""What one flipped bit, or one byte lost or added, does to a stream of frames. Run as a program for a long count.

python tests/firmware_protocol/link_damage.py ccsds-cobs 1000000
"""

import random
import sys
from collections import Counter
from itertools import islice

from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import Profile

MAX_PAYLOAD = 256
STREAM = 3
TRIES_PER_STREAM = 200


def payload(source):
    """A payload of one of the kinds that framings find hard, at most MAX_PAYLOAD long."""
    length = source.randrange(1, MAX_PAYLOAD + 1)
    kind = source.randrange(4)
    if kind == 0:
        return source.randbytes(length)
    if kind == 1:
        return bytes(source.choices((0, 0, 1, 2, 255), k=length))
    if kind == 2:
        return bytes(source.choices((0xC0, 0xDB, 0xDC, 0xDD, 0), k=length))
    return (b"\xde\xad\xbe\xef\0\0\0\x10" * (length // 8 + 1))[:length]


def damaged(source, stream):
    """The stream with one bit flipped, one byte lost, or one added."""
    at = source.randrange(len(stream))
    kind = source.randrange(3)
    if kind == 0:
        return stream[:at] + bytes([stream[at] ^ 1 << source.randrange(8)]) + stream[at + 1 :]
    if kind == 1:
        return stream[:at] + stream[at + 1 :]
    return stream[:at] + bytes([source.randrange(256)]) + stream[at:]


def tries(name, seed):
    """Yield the results of one try after another, without end."""
    source = random.Random(f"{name} {seed}")
    profile = Profile(name, max_payload=MAX_PAYLOAD)
    while True:
        events = [Message(MessageKind.EVENTS, payload(source), source.randrange(2**40)) for _ in range(STREAM)]
        before = Message(MessageKind.EVENTS, b"before", 0)
        # Two frames in front and behind take no damage: they make the counts tell of every loss between them.
        front = profile.wrap(before)
        stream = b"".join(map(profile.wrap, events))
        behind = [Message(MessageKind.EVENTS, b"behind", 1), Message(MessageKind.EVENTS, bytes(MAX_PAYLOAD), 2)]
        tail = b"".join(map(profile.wrap, behind))
        for _ in range(TRIES_PER_STREAM):
            yield result(source, profile, [before, *events, *behind], (front, stream, tail))


def result(source, profile, messages, parts):
    """Damage the middle part; return (messages lost, wrong messages, losses that the counts do not tell)."""
    front, stream, tail = parts
    unwrapper = profile.unwrapper()
    got = [r.message for r in unwrapper.push(front + damaged(source, stream) + tail)]
    sent = iter(messages)
    wrong = sum(1 for message in got if not any(message == other for other in sent))
    lost = len(messages) - len(got) + wrong
    untold = lost - unwrapper.counters.missing if got and got[-1] == messages[-1] else 0
    return lost, wrong, untold


def survey(name, count, seed=0):
    """Return the number of tries by messages lost, wrong messages, and losses untold, over `count` tries."""
    lost, wrong, untold = Counter(), 0, 0
    for n, bad, hidden in islice(tries(name, seed), count):
        lost[n] += 1
        wrong += bad
        untold += hidden != 0
    return lost, wrong, untold


if __name__ == "__main__":
    lost, wrong, untold = survey(sys.argv[1], int(sys.argv[2]))
    sys.stdout.write(f"{sys.argv[1]}: lost {dict(sorted(lost.items()))}, wrong {wrong}, untold {untold}\n")
