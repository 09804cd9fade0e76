"""What can go wrong while the rig is driven: counts that stop or begin again, clocks, numbers, terminals."""

import json
import math
import os

import numpy as np
import pytest

from acino_fte.rig.drive_keys import Keyboard, keys_in, split_keys
from acino_fte.rig.drive_session import Axis, DriveSession
from acino_fte.rig.encoders import Encoder, LineCounts, ReportedCounts
from acino_fte.rig.encoders_shared import CountsWriter, SharedCounts
from acino_fte.rig.encoders_store import PositionStore
from acino_fte.rig.gpio import EdgeBatch, SimulatedBridge
from acino_fte.rig.motors import HBridge, LinkOutput, MotorControl
from acino_fte.rig.motors_homing import Homing
from acino_fte.rig.motors_simulated import SimulatedGearmotor
from acino_fte.rig.quadrature import NO_EDGES
from acino_fte.rig.serial_frames import Count, FramedLines, Throttle, frame
from acino_fte.rig.serial_link import LISTEN_NS, SerialLink
from acino_fte.rig.serial_link_simulated import SimulatedController, SimulatedPort

MS = 1_000_000
STEP = 20 * MS


class Rig:
    """One ring behind a simulated microcontroller, keys, and time that is stepped."""

    def __init__(self, folder, others=()):
        self.now = 0
        self.gear = SimulatedGearmotor(20_000, (-100, 40_100))
        self.controller = SimulatedController({1: self.gear}, lambda: self.now)
        self.port = SimulatedPort(self.controller)
        self.report, self.store = ReportedCounts(), PositionStore(folder)
        self.folder, self.shared = folder, CountsWriter(folder)
        self.encoder = Encoder("zoom", self.report, 4741.44, store=self.store, self_locking=True)
        output = LinkOutput(1)
        self.motor = MotorControl(self.encoder, output, limits=(0, 40_000))
        self.axis = Axis("zoom", self.encoder, self.motor, output, self.report)
        self.session = DriveSession(
            [self.axis, *others],
            SerialLink(self.port.open, (1,)),
            store=self.store,
            shared=self.shared,
            clock=lambda: self.now,
        )
        self.run(0.2)
        self.encoder.zero(20_000)

    def run(self, seconds, keys=()):
        for _ in range(round(seconds / 0.02)):
            self.now += STEP
            status = self.session.step(keys)
            self.controller.advance()
        return status

    def mute(self):
        """The reports stop; commands are still obeyed."""
        self.controller._report = lambda: None

    def reader(self):
        return SharedCounts("", {"zoom": None}, folder=self.folder, clock=lambda: self.now)

    def end(self):
        def wait(seconds):
            self.now += round(seconds * 1e9)

        self.session.close(wait)


def test_counts_that_stop_stop_the_motor_and_are_not_trusted(tmp_path):
    rig = Rig(tmp_path)
    rig.session.speed = 5
    rig.run(0.6, ["right"])
    assert rig.gear.speed > 7000 and rig.motor.homed
    assert len(rig.reader().counts()) == 1
    rig.mute()
    status = rig.run(0.24, ["right"])
    assert rig.gear.power == 0.0 and status.axes[0].trouble == "no counts come"
    assert not rig.motor.homed and not status.axes[0].reading.sure
    rig.run(0.2)
    rig.run(0.5, ["right"])  # pressed again, the key drives slowly, and stops again
    assert rig.motor.fault == "no counts come" and rig.gear.power == 0.0
    rig.now += 600 * MS
    assert rig.reader().counts() == ()  # a recording gets none rather than old ones
    rig.end()
    tomorrow = Encoder("zoom", ReportedCounts(), 4741.44, store=PositionStore(tmp_path), self_locking=True)
    tomorrow.source.put(0, 0)
    tomorrow.poll(0)
    assert not tomorrow.sure


def test_leaving_while_the_cable_is_out_does_not_keep_the_position_as_certain(tmp_path):
    for k, fault in enumerate(("unplugged", "mute", "")):
        rig = Rig(tmp_path / str(k))
        rig.run(0.6, ["right"])
        rig.port.plugged = fault != "unplugged"
        if fault == "mute":
            rig.mute()
        rig.run(0.04, ["right"])
        rig.end()
        assert PositionStore(rig.folder).get("zoom").at_rest == (not fault)


def test_no_counts_are_not_the_stop_that_homing_looks_for(tmp_path):
    rig = Rig(tmp_path)
    rig.run(0.02, ["h"])
    rig.run(0.02, ["h"])
    rig.run(0.3)
    assert rig.axis.homing.under_way
    rig.mute()
    rig.run(1.0)
    assert rig.axis.homing.phase == "failed" and rig.gear.power == 0.0


def test_a_stall_from_before_is_not_the_stop_that_homing_looks_for(tmp_path):
    rig = Rig(tmp_path)
    rig.gear.jammed = True
    rig.run(0.6, ["right"])
    assert rig.motor.fault == "stalled"
    rig.gear.jammed = False
    homing = Homing(rig.motor, rig.now)
    homing.step(rig.now)
    assert homing.phase == "to the low end"


def test_a_counter_that_begins_again_after_a_pause_is_not_a_movement():
    """Behind an adapter the port stays open while the microcontroller starts: 1.5 s without a report."""
    for before, after in ((5000, (0, 0)), (300, (0, 3)), (1000, (0, 12))):
        source = ReportedCounts()
        encoder = Encoder("zoom", source, 4741.44)
        source.put(before, 0)
        encoder.poll(0)
        encoder.zero(before)
        for k, counts in enumerate(after):
            source.put(counts, 1500 * MS + k * STEP)
            if source.restarted:
                encoder.interrupted(restarted=True)
            encoder.poll(1500 * MS + k * STEP)
        assert (encoder.counts, encoder.sure) == (before, False)


def test_a_ring_that_comes_by_zero_has_not_begun_again():
    source = ReportedCounts()
    for k, counts in enumerate(range(1500, -1500, -150)):
        source.put(counts, k * STEP)
        assert source.counts == counts
    source.put(0, 5 * STEP + 10**9)  # one wrong report after a pause
    source.put(-1400, 6 * STEP + 10**9)
    assert (source.counts, source.restarted, source.glitches.illegal) == (-1400, False, 1)


def bench():
    """A motor, an encoder that always knows, what the motor was told."""
    source = ReportedCounts()
    source.counts = 5000
    encoder, output = Encoder("zoom", source, 4741.44), LinkOutput(1)
    encoder.poll(0)
    encoder.zero(5000)
    return MotorControl(encoder, output, limits=(0, 10**6)), output


@pytest.mark.parametrize("power", [math.nan, math.inf, -math.inf])
def test_a_power_that_is_no_number_is_none(power):
    motor, output = bench()
    for k in range(20):
        motor.command(power, k * STEP)
        motor.update(k * STEP)
    assert output.speed == 0
    output.set(power)
    assert output.speed == 0
    bridge = SimulatedBridge()
    HBridge(bridge).set(power)
    assert bridge.told[-1][1] == 0.0


def test_a_clock_that_goes_back_does_not_keep_a_motor_alive():
    motor, output = bench()
    for k in range(10):
        motor.command(1.0, 10**10 + k * STEP)
        motor.update(10**10 + k * STEP)
    assert output.speed > 0
    motor.update(10**9)
    assert output.speed == 0


def test_after_a_pause_of_the_program_the_ramp_begins_again():
    motor, _ = bench()
    for k in range(14):
        motor.command(1.0, k * STEP)
        motor.update(k * STEP)
    assert motor.power == 1.0
    for late, most in ((5 * 10**9, 0.0), (5 * 10**9 + STEP, 0.08)):  # as of a computer that was put to sleep
        motor.command(1.0, late)
        assert motor.update(late) == pytest.approx(most)


def test_every_frame_is_taken_over_many_rounds_of_numbers_and_after_every_interruption():
    """Sequence numbers wrap, the cable is out in the middle of a frame, the device starts again."""
    rng = np.random.default_rng(0)
    host, number, now = FramedLines("host"), 0, 0
    taken, sent = [], []
    for k in range(2000):
        now += STEP
        what = rng.integers(20)
        line = frame(Count(1, k), number)
        if what == 0:  # pulled in the middle of the frame, and plugged in within the rest of another
            cut = int(rng.integers(1, len(line)))
            taken += host.feed(line[:cut], now)
            host.interrupted()
            taken += host.feed(line[cut:], now)
            number = int(rng.integers(256))
        else:
            sent.append(k)
            taken += host.feed(line, now)
            if what == 1:  # an echo
                taken += host.feed(line, now)
            number = (number + 1) % 256
    assert [message.count for message in taken] == sent
    assert host.counts.duplicates > 50 and host.counts.lost == 0 and host.counts.bad_crc == 0


def test_a_device_that_starts_again_is_heard_within_200_ms_whatever_its_number():
    for last in range(256):
        host = FramedLines("host")
        assert host.feed(frame(Count(1, 7), last), 0)
        heard = [k for k in range(15) if host.feed(frame(Count(1, 0), k), (k + 1) * STEP)]
        assert heard[0] <= 10 and heard == list(range(heard[0], 15))


class Talker:
    """A port whose device says this every second."""

    def __init__(self, text):
        self.text, self.written = text, b""

    def read(self):
        return self.text

    def write(self, data):
        self.written += data

    def close(self):
        pass


def test_nothing_is_said_to_a_device_that_is_not_understood():
    port = Talker(b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M\r\n")
    link = SerialLink(lambda: port)
    session = DriveSession([], link, clock=lambda: 0)
    for k in range(10):
        link.poll(k * 1000 * MS)
        assert not link.send(Throttle(1, 0))
    assert port.written == b"" and "is this the microcontroller?" in session.status(10**10).link
    port.text = b""  # only a banner: after the silence it is spoken to
    link.poll(9 * 1000 * MS + LISTEN_NS)
    assert link.protocol == "plain"


class Pulled:
    """Lines of a chip that can be pulled."""

    levels = (0, 0)
    gone = False

    def read(self):
        if self.gone:
            raise OSError(19, "No such device")
        return EdgeBatch(NO_EDGES, 0)

    def close(self):
        pass


def test_lines_that_cannot_be_read_any_more_do_not_end_driving(tmp_path):
    lines = Pulled()
    head = Encoder("pan", LineCounts(lines), 4000.0)
    rig = Rig(tmp_path, [Axis("pan", head)])
    head.zero()
    assert head.certain
    lines.gone = True
    status = rig.run(0.4, ["right"])
    assert "No such device" in status.axes[1].trouble and not status.axes[1].reading.sure
    assert rig.gear.speed > 0
    lines.gone = False
    status = rig.run(0.02)
    assert status.axes[1].trouble == "" and not status.axes[1].reading.sure  # what was turned is not known


@pytest.mark.parametrize(
    "change", [{"at_rest": "false"}, {"limits": [5, 5]}, {"limits": [9, 0]}, {"counts": 10**30}]
)
def test_impossible_positions_are_not_taken_up(tmp_path, change):
    good = {"counts": 1, "at_rest": True, "sure": True, "index_at": None, "limits": [0, 9]}
    path = tmp_path / "positions.json"
    for content, taken in ((good, True), (good | change, False)):
        path.write_text(json.dumps({"format": "acino-fte/rig-positions/1", "encoders": {"zoom": content}}))
        store = PositionStore(tmp_path)
        assert (store.get("zoom") is not None, store.trouble == "") == (taken, taken)


def test_a_key_whose_bytes_come_one_by_one_is_one_key(monkeypatch):
    assert split_keys(b"a\x1b[1;5") == (b"a", b"\x1b[1;5")
    assert split_keys(b"\x1b[C\x1bq") == (b"\x1b[C\x1bq", b"")
    assert keys_in("\x1b[1;5C") == []
    read, write = os.pipe()
    keyboard = Keyboard()
    keyboard._fd = read
    pressed = []
    for byte in b"\x1b[C\x1bOA5\x1b":
        os.write(write, bytes([byte]))
        pressed += keyboard.read()
    pressed += keyboard.read()  # nothing more: that was the key Esc, which stops
    assert pressed == ["right", "up", "5", "escape"]
    os.close(write)
    assert keyboard.read() == ["q"]
    os.close(read)
