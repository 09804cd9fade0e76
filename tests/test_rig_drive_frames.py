"""The lines between computer and microcontroller: nothing but a message that was sent becomes one."""

from itertools import combinations
from random import Random

import numpy as np
import pytest

from acino_fte.errors import InputError
from acino_fte.rig.serial_frames import (
    MAX_LINE,
    RESYNC_NS,
    Count,
    FramedLines,
    PlainLines,
    Reset,
    Throttle,
    Turns,
    body,
    frame,
    parse,
)

N = 1_000_000
THROTTLES = [Throttle(motor, speed) for motor in (1, 2) for speed in range(-800, 801)]
COMMANDS = {body(message): message for message in THROTTLES}
COMMANDS[b"reset"] = Reset()


def pieces(data, rng, longest=64):
    cuts = np.cumsum(rng.integers(1, longest, 2 * len(data) // longest))
    cuts = [0, *cuts[cuts < len(data)], len(data)]
    return [data[i:j] for i, j in zip(cuts[:-1], cuts[1:], strict=True)]


def subsequence(part, whole):
    rest = iter(whole)
    return all(item in rest for item in part)


def test_messages_of_the_field():
    device, host = PlainLines("device"), PlainLines("host")
    assert device.feed(b"t1-200\nt1200\r\nt2800\nt10\nreset\n") == [
        Throttle(1, -200), Throttle(1, 200), Throttle(2, 800), Throttle(1, 0), Reset()
    ]  # fmt: skip
    assert host.feed(b"p1-4741\nr1-1.0000\np20\nr20.25\n") == [
        Count(1, -4741), Turns(1, -1.0), Count(2, 0), Turns(2, 0.25)
    ]  # fmt: skip
    assert device.counts.refused == host.counts.refused == 0
    for message in (Throttle(2, -799), Reset(), Count(1, -(2**31)), Turns(1, -0.5)):
        assert parse(body(message)) == message


@pytest.mark.parametrize(
    "line",
    [
        *(b"t1", b"t0100", b"t3100", b"t1+5", b"t105", b"t1-0", b"t1--5", b"t1 5", b" t15", b"T15", b"t15.0"),
        *(b"t1\xb2", b"t15 ", b"t1-2t1-200", b"resett15", b"Reset", b"p15", b"r15", b"t1200000", b"\0t15"),
        b"$00t15*0000",
    ],
)
def test_what_is_spelt_otherwise_is_refused(line):
    """Also the ambiguous ones: a motor has one digit, so t1200 is motor 1 and there is no motor 12."""
    device = PlainLines("device")
    assert device.feed(line + b"\n") == []
    assert device.counts.junk == 1


def test_out_of_range_is_refused_and_not_clipped():
    device, host = PlainLines("device"), PlainLines("host")
    assert device.feed(b"t1801\nt1-801\nt2999\n") == []
    assert device.counts.out_of_range == 3
    assert host.feed(b"p19999999999\n") == []
    assert host.counts.out_of_range == 1
    for message in (Throttle(1, 801), Throttle(12, 0), Throttle(0, 0), Count(1, 2**31)):
        with pytest.raises(InputError, match="cannot be sent"):
            body(message)


def test_partial_and_overlong_lines():
    device = PlainLines("device")
    taken = [device.feed(bytes([byte])) for byte in b"t1-200\n"]
    assert sum(taken, []) == [Throttle(1, -200)]
    assert device.feed(b"t1" + b"0" * 10_000) == []
    assert device.feed(b"5\nt25\n") == [Throttle(2, 5)]  # the end of the long line is not a message
    assert device.counts.overlong == 1
    assert device.feed(b"t1-8") == []
    device.interrupted()
    assert device.feed(b"t15\n") == [Throttle(1, 5)]
    assert max(len(frame(m, 255)) for m in (Count(1, -(2**31)), Turns(2, -999999.5))) < MAX_LINE


@pytest.mark.parametrize(
    ("alphabet", "n"), [(bytes(range(256)), N), (b"t12058-\r\n", N), (b"$*tre120358-ACF\n", N // 4)]
)
def test_a_million_fuzzed_bytes(alphabet, n):
    """Any bytes, and those of which messages are made: plain takes what is a command, framed nothing."""
    rng = np.random.default_rng(len(alphabet))
    data = rng.choice(np.frombuffer(alphabet, np.uint8), n).tobytes()
    plain, framed = PlainLines("device"), FramedLines("device")
    taken = []
    for piece in pieces(data, rng, 400):
        taken += plain.feed(piece)
        assert framed.feed(piece) == []
    lines = [line.removesuffix(b"\r") for line in data.split(b"\n")[:-1]]
    assert taken == [COMMANDS[line] for line in lines if line in COMMANDS]
    assert framed.counts.refused > 3000


def test_fuzzed_bytes_at_the_computer():
    """Reports: every one that is taken is spelt in the bytes as it would be sent."""
    rng = np.random.default_rng(5)
    data = rng.choice(np.frombuffer(b"pppprr1122.-0\n\n\n\n", np.uint8), N // 4).tobytes()
    plain, framed = PlainLines("host"), FramedLines("host")
    taken = [message for piece in pieces(data, rng, 400) for message in plain.feed(piece)]
    assert framed.feed(data) == []
    lines = set(data.split(b"\n"))
    counts = [message for message in taken if isinstance(message, Count)]
    assert len(counts) > 300 and len(taken) > len(counts)
    assert all(body(message) in lines for message in counts)
    assert all(np.isfinite(message.turns) for message in taken if isinstance(message, Turns))


def damaged(frames, rng):
    """Frames, a third of them hurt: flipped bits, lost and added bytes, bursts, doubled and swapped lines."""
    out = []
    for line in frames:
        kind = rng.randrange(30)
        text = bytearray(line)
        at = rng.randrange(len(text))
        if kind < 4:
            for _ in range(kind + 1):
                text[rng.randrange(len(text))] ^= 1 << rng.randrange(8)
        elif kind == 4:
            del text[at : at + rng.randint(1, 4)]
        elif kind == 5:
            text[at:at] = rng.randbytes(rng.randint(1, 4))
        elif kind == 6:
            text[at : at + 3] = rng.randbytes(3)
        elif kind == 7:
            text *= 2
        elif kind == 8 and out:
            text, out[-1] = out[-1], text
        out.append(text)
    return b"".join(out)


def test_a_million_bytes_of_damaged_frames_give_no_wrong_command():
    rng = np.random.default_rng(11)
    n = N // 14
    sent = [THROTTLES[k] for k in rng.integers(0, len(THROTTLES), n)]
    data = damaged([frame(message, k % 256) for k, message in enumerate(sent)], Random(11))
    assert len(data) >= N
    device = FramedLines("device")
    taken = [message for piece in pieces(data, rng) for message in device.feed(piece)]
    assert subsequence(taken, sent)  # each as it was sent, in that order
    assert 0.7 * n < len(taken) < 0.8 * n
    counts = device.counts
    assert min(counts.bad_crc, counts.duplicates, counts.junk, counts.lost, counts.out_of_order) > 1000


def flips(line):
    for place in range(8 * len(line)):
        text = bytearray(line)
        text[place // 8] ^= 1 << place % 8
        yield bytes(text)


def test_a_flipped_bit_never_makes_another_command_of_a_frame():
    """Every bit, the line's end too, between two frames that are whole."""
    for k, message in enumerate([*COMMANDS.values()][::20]):
        before, after = Throttle(1, 1), Throttle(2, 2)
        around = frame(before, k % 256), frame(after, (k + 2) % 256)
        for line in flips(frame(message, (k + 1) % 256)):
            taken = FramedLines("device").feed(around[0] + line + around[1])
            assert subsequence(taken, [before, message, after]) and before in taken


def test_two_flipped_bits_never_make_another_command_of_a_frame():
    sent = Throttle(1, -200)
    line = frame(sent, 5)
    for i, j in combinations(range(8 * len(line)), 2):
        text = bytearray(line)
        text[i // 8] ^= 1 << i % 8
        text[j // 8] ^= 1 << j % 8
        assert FramedLines("device").feed(bytes(text)) in ([], [sent])


def test_what_plain_lines_cannot_guarantee():
    """A flipped bit or a lost byte may make another command of a plain line: how often."""
    wrong = {"flipped": [0, 0], "lost": [0, 0]}
    for text, message in [*COMMANDS.items()][::7]:
        line = text + b"\n"
        shorter = [line[:k] + line[k + 1 :] for k in range(len(line))]
        for name, hurt in (("flipped", flips(line)), ("lost", shorter)):
            for other in hurt:
                taken = PlainLines("device").feed(other)
                wrong[name][0] += any(command != message for command in taken)
                wrong[name][1] += 1
    share = {name: part / whole for name, (part, whole) in wrong.items()}
    assert share["flipped"] == pytest.approx(0.16, abs=0.01)
    assert share["lost"] == pytest.approx(0.53, abs=0.01)


def test_numbers_of_frames():
    device = FramedLines("device")
    say = lambda number, speed, now=0: device.feed(frame(Throttle(1, speed), number), now)  # noqa: E731
    assert say(250, 1) == [Throttle(1, 1)]  # any number to begin with
    assert say(250, 2) == []
    assert say(249, 3) == []
    assert say(252, 4) == [Throttle(1, 4)]
    assert say(2, 5) == [Throttle(1, 5)]  # 253, 254, 255, 0, 1 are lost
    counts = device.counts
    assert (counts.duplicates, counts.out_of_order, counts.lost) == (1, 1, 6)
    assert say(1, 6, RESYNC_NS) == []
    assert say(1, 7, RESYNC_NS + 1) == [Throttle(1, 7)]  # a sender that started again
    device.interrupted()
    assert say(0, 8, RESYNC_NS + 2) == [Throttle(1, 8)]


def test_sides_do_not_listen_to_themselves():
    for kind in (PlainLines, FramedLines):
        host, device = kind("host"), kind("device")
        assert host.feed(host.encode(Throttle(1, 5))) == []
        assert device.feed(device.encode(Count(1, 5))) == []
        assert device.feed(host.encode(Throttle(1, 7)), 10**9) == [Throttle(1, 7)]
    assert FramedLines("device").feed(b"t1800\n") == []  # framed takes no plain command
    assert PlainLines("device").feed(frame(Throttle(1, 5), 0)) == []
