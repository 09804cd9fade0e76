"""The line to the microcontroller: over a real pseudo-terminal with pyserial, and a simulated cable."""

import os
import select
import sys
import tty
from pathlib import Path

import pytest

from acino_fte.errors import InputError
from acino_fte.rig.gpio import GpiozeroEdges, open_edges
from acino_fte.rig.motors_simulated import FULL_SPEED, SimulatedGearmotor
from acino_fte.rig.serial_frames import Count, Throttle, Turns, frame
from acino_fte.rig.serial_link import LISTEN_NS, RETRY_NS, SerialLink, SerialPort, find_port
from acino_fte.rig.serial_link_simulated import SimulatedController, SimulatedPort

MS = 1_000_000
STEP = 20 * MS


class Clock:
    def __init__(self):
        self.now = 0

    def __call__(self):
        return self.now


class Cable:
    """A pseudo-terminal: the computer's end is a serial port, the other a simulated microcontroller's.

    Bytes take real time through the kernel; what is asserted is in the time of the clock alone.
    """

    def __init__(self, path, controller):
        self.path, self.controller = path, controller
        self.plug()

    def plug(self):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def unplug(self):
        os.close(self.master)
        self.path.unlink()

    def to_controller(self):
        """Hand over the lines that were sent, however long the kernel takes."""
        data = b""
        while not data.endswith(b"\n"):
            assert select.select([self.master], [], [], 10)[0]
            data = os.read(self.master, 4096)
            self.controller.receive(data)

    def to_computer(self):
        os.write(self.master, self.controller.transmit())


def controller_of(clock, **rest):
    motors = {1: SimulatedGearmotor(), 2: SimulatedGearmotor()}
    return SimulatedController(motors, clock, **rest)


def read_until(link, clock, n):
    """Messages, until there are this many, however long the kernel takes."""
    messages = []
    for _ in range(2000):
        messages += link.poll(clock.now)
        if len(messages) >= n:
            return messages
        select.select([], [], [], 0.005)
    raise AssertionError(f"{len(messages)} of {n} messages came")


@pytest.mark.parametrize("framed", [True, False])
def test_commands_stop_and_the_motor_stops_over_a_real_pty(tmp_path, framed):
    """Its own dead-man, in the clock's time; then the cable is pulled at full speed, and plugged in again."""
    clock = Clock()
    controller = controller_of(clock, framed=framed)
    cable = Cable(tmp_path / "ttyACM0", controller)
    link = SerialLink(lambda: SerialPort(str(cable.path)))
    gear = controller.motors[1]

    def turn(speed=None):
        clock.now += STEP
        if speed is not None:
            assert link.send(Throttle(1, speed))
            cable.to_controller()
        controller.advance()

    assert link.poll(clock.now) == []  # opens it
    clock.now += STEP
    cable.to_computer()
    assert read_until(link, clock, 4)[0] == Count(1, 0)
    assert link.protocol == ("framed" if framed else "plain")
    for _ in range(50):
        turn(800)
    assert gear.speed == pytest.approx(FULL_SPEED, rel=0.01)
    for _ in range(200 * MS // STEP):
        turn()
    assert gear.power == 0.0
    assert abs(gear.speed) < 0.02 * FULL_SPEED
    controller.transmit()

    for _ in range(20):
        turn(-800)
    assert gear.speed < -0.9 * FULL_SPEED
    cable.unplug()
    assert link.poll(clock.now) == []
    assert not link.connected and link.interruptions == 1
    assert not link.send(Throttle(1, -800))
    for _ in range(200 * MS // STEP):
        turn()
    assert gear.power == 0.0 and abs(gear.speed) < 0.02 * FULL_SPEED
    clock.now += RETRY_NS
    assert link.poll(clock.now) == [] and not link.connected  # still out
    cable.plug()
    controller.transmit()
    clock.now += RETRY_NS
    link.poll(clock.now)
    assert link.connected and link.ready
    cable.to_computer()
    assert read_until(link, clock, 4)[0] == Count(1, gear.counts)
    turn(100)
    assert gear.power == 0.125
    link.close()
    os.close(cable.master)


def test_a_port_belongs_to_one_program(tmp_path):
    cable = Cable(tmp_path / "tty", controller_of(Clock()))
    first = SerialPort(str(cable.path))
    with pytest.raises(OSError, match="lock|busy|exclusive"):
        SerialPort(str(cable.path))
    first.close()
    SerialPort(str(cable.path)).close()
    os.close(cable.master)


@pytest.mark.parametrize("framed", [True, False])
def test_the_protocol_is_heard(framed):
    clock = Clock()
    port = SimulatedPort(controller_of(clock, framed=framed))
    link = SerialLink(port.open)
    assert link.poll(0) == []
    assert not link.ready and not link.send(Throttle(1, 100))  # nothing is said before it is known
    clock.now = 2 * STEP
    messages = link.poll(clock.now)
    assert [type(message) for message in messages[:2]] == [Count, Turns]
    assert link.ready and link.protocol == ("framed" if framed else "plain")
    assert link.send(Throttle(2, 300))
    assert port.controller.motors[2].power == 0.375


def test_a_silent_device_is_spoken_to_in_plain_lines():
    class Silent:
        told = b""

        def read(self):
            return b""

        def write(self, data):
            self.told += data

        def close(self):
            pass

    port = Silent()
    link = SerialLink(lambda: port)
    link.poll(0)
    link.poll(LISTEN_NS - 1)
    assert not link.ready
    link.poll(LISTEN_NS)
    assert link.send(Throttle(1, -5))
    assert port.told == b"t1-5\n"


def test_a_line_cut_by_the_cable_is_not_gone_on_with():
    class Script:
        def __init__(self):
            self.data = [frame(Count(1, k), k) for k in range(3)] + [
                b"$03p17",
                None,
                b"7*",
                frame(Count(1, 9), 0),
            ]

        def read(self):
            data = self.data.pop(0)
            if data is None:
                raise OSError("gone")
            return data

        def close(self):
            pass

    port = Script()
    link = SerialLink(lambda: port)
    found = [message for k in range(7) for message in link.poll(k * RETRY_NS)]
    assert found == [Count(1, 0), Count(1, 1), Count(1, 2)]  # "7*$00p19…" is one damaged line
    assert (link.interruptions, link.counts.junk) == (1, 1)


def test_ports_are_found_by_their_name(monkeypatch, tmp_path):
    from serial.tools import list_ports
    from serial.tools.list_ports_common import ListPortInfo

    def ports(*names):
        found = [ListPortInfo(name) for name in names]
        for port in found:
            port.vid = 0x2341
        built_in = ListPortInfo("/dev/ttyS0")
        monkeypatch.setattr(list_ports, "comports", lambda: [*found, built_in])

    ports()
    with pytest.raises(InputError, match="No microcontroller is plugged in"):
        find_port(tmp_path)
    device = tmp_path / "ttyACM3"
    device.touch()
    ports(str(device))
    assert find_port(tmp_path / "none") == str(device)
    by_id = tmp_path / "by-id"
    by_id.mkdir()
    (by_id / "usb-Arduino_123").symlink_to(device)
    assert find_port(by_id) == str(by_id / "usb-Arduino_123")
    ports(str(device), "/dev/ttyUSB0")
    with pytest.raises(InputError, match="--port"):
        find_port(by_id)


def test_a_port_that_is_none(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "missing", Path("/dev/null")):
        link = SerialLink(lambda path=path: SerialPort(str(path)))
        assert link.poll(0) == []
        assert not link.connected and link.trouble


def test_missing_packages_name_the_remedy(monkeypatch):
    for name in ("serial", "serial.tools.list_ports", "gpiod", "gpiozero"):
        monkeypatch.setitem(sys.modules, name, None)
    link = SerialLink(lambda: SerialPort("/dev/ttyACM0"))
    link.poll(0)
    assert "acino-fte[rig]" in link.trouble
    for needs in (find_port, lambda: open_edges("gpiochip0 1 2"), lambda: GpiozeroEdges([1, 2])):
        with pytest.raises(InputError, match=r"acino-fte\[rig\]"):
            needs()
