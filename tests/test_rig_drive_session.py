"""Driving as a whole: a simulated rig, an injected clock, stick, keys, the cable, the screen, the command."""

import io
import json

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from acino_fte.cli_rig_drive import drive
from acino_fte.errors import InputError
from acino_fte.rig import drive_setup
from acino_fte.rig.drive_keys import keys_in
from acino_fte.rig.drive_screen import said, screen, where
from acino_fte.rig.drive_session import Axis, DriveSession
from acino_fte.rig.drive_setup import motor_numbers, open_session, open_simulated
from acino_fte.rig.encoders import Encoder, ReportedCounts
from acino_fte.rig.encoders_shared import SharedCounts
from acino_fte.rig.encoders_store import PositionStore
from acino_fte.rig.joystick import Axis as StickAxis
from acino_fte.rig.joystick import Joystick, SimulatedAdc
from acino_fte.rig.joystick_calibration import AxisCalibration
from acino_fte.rig.motors import LinkOutput, MotorControl
from acino_fte.rig.motors_simulated import FULL_SPEED, SimulatedGearmotor
from acino_fte.rig.rig_file import EncoderPart, RigFile
from acino_fte.rig.serial_link import SerialLink
from acino_fte.rig.serial_link_simulated import SimulatedController, SimulatedPort

STEP = 20_000_000
CALIBRATION = AxisCalibration(100, 500, 900)


class Rig:
    """Zoom and focus behind a simulated microcontroller, a stick, and time that is stepped."""

    def __init__(self, folder=None, limits=(0, 40_000), stick=True, framed=True):
        self.now = 0
        self.gears = {k: SimulatedGearmotor(20_000, (-100, 40_100)) for k in (1, 2)}
        self.controller = SimulatedController(self.gears, lambda: self.now, framed=framed)
        self.port = SimulatedPort(self.controller)
        self.adc = SimulatedAdc((500, 500))
        self.store = PositionStore(folder) if folder else None
        axes = []
        for name, number in (("zoom", 1), ("focus", 2)):
            report, output = ReportedCounts(), LinkOutput(number)
            encoder = Encoder(name, report, 4741.44, store=self.store, self_locking=True)
            axes.append(Axis(name, encoder, MotorControl(encoder, output, limits=limits), output, report))
        self.zoom, self.focus = axes
        joystick = Joystick(self.adc, [StickAxis(CALIBRATION), StickAxis(CALIBRATION)]) if stick else None
        self.session = DriveSession(
            axes, SerialLink(self.port.open), joystick=joystick, store=self.store, clock=lambda: self.now
        )
        self.run(0.2)
        if limits:
            for axis in axes:
                axis.encoder.zero(20_000)

    def run(self, seconds, keys=()):
        for _ in range(round(seconds / 0.02)):
            self.now += STEP
            status = self.session.step(keys)
            self.controller.advance()
        return status


def speed(rig, motor=1):
    return rig.gears[motor].speed / FULL_SPEED


def test_the_stick_drives_and_letting_go_stops_within_200_ms():
    rig = Rig()
    rig.adc.raw = [900, 500]
    status = rig.run(0.8)
    assert speed(rig) > 0.99 and speed(rig, 2) == 0
    assert status.axes[0].power == pytest.approx(1.0)
    rig.adc.raw = [500, 100]
    rig.run(0.18)
    assert rig.gears[1].power == 0 and abs(speed(rig)) < 0.01
    rig.run(0.6)
    assert speed(rig, 2) < -0.99


@pytest.mark.parametrize("framed", [True, False])
def test_the_program_dies_and_the_motors_stop_within_200_ms(framed):
    """Commands stop: no turn of the loop comes any more."""
    rig = Rig(framed=framed)
    rig.adc.raw = [900, 900]
    rig.run(0.8)
    assert min(speed(rig, 1), speed(rig, 2)) > 0.99
    last = rig.now
    while rig.now < last + 200_000_000:
        rig.now += 1_000_000
        rig.controller.advance()
    for gear in rig.gears.values():
        assert gear.power == 0 and abs(gear.speed) < 0.01 * FULL_SPEED


def test_a_stick_that_cannot_be_read_stops_the_motors():
    rig = Rig()
    rig.adc.raw = [900, 500]
    rig.run(0.8)
    rig.adc.read = lambda: (_ for _ in ()).throw(OSError(5, "Input/output error"))
    status = rig.run(0.2)
    assert abs(speed(rig)) < 0.02
    assert "cannot be read" in status.stick


def test_keys_nudge_and_hold():
    rig = Rig(stick=False)
    start = rig.gears[1].position
    rig.run(0.02, ["right"])
    rig.run(0.5)
    nudge = rig.gears[1].position - start
    assert 50 < nudge < 1000 and speed(rig) == pytest.approx(0, abs=1e-6)
    rig.run(1.0, ["right"])
    assert speed(rig) == pytest.approx(0.5, abs=0.01)  # speed 3 of 5
    rig.run(0.2)
    assert speed(rig) == pytest.approx(0, abs=0.01)
    rig.run(0.02, ["5"])
    rig.run(0.5, ["down"])
    assert speed(rig, 2) < -0.9
    rig.run(0.02, [" "])
    assert rig.gears[2].power == 0


def test_the_cable_is_pulled_and_nothing_moves_again_by_itself():
    rig = Rig()
    rig.adc.raw = [900, 500]
    rig.run(0.8)
    rig.port.plugged = False
    status = rig.run(0.2)
    assert abs(speed(rig)) < 0.02 and not status.link_good
    assert "not connected: the cable is out" in status.link
    place = rig.gears[1].position
    rig.port.plugged = True
    status = rig.run(2.0)  # the stick is still held over
    assert status.link_good and rig.gears[1].position == pytest.approx(place, abs=150)
    assert "let go" in status.stick
    assert rig.zoom.encoder.counts == pytest.approx(rig.gears[1].position, abs=60)
    assert rig.zoom.encoder.sure
    rig.adc.raw = [500, 500]
    rig.run(0.1)
    rig.adc.raw = [100, 500]
    rig.run(0.5)
    assert speed(rig) < -0.9


def test_a_microcontroller_that_starts_again_is_told():
    rig = Rig()
    place = rig.zoom.encoder.counts
    for gear in rig.gears.values():
        gear.reset()
        gear.position += 7000  # its counter says something else: 7000
    status = rig.run(0.2)
    assert abs(rig.zoom.encoder.counts - place) < 10  # the ring did not move
    assert not rig.zoom.encoder.sure
    assert any("home the rings" in note for note in status.notes)


def test_one_wrong_report_is_left_out():
    rig = Rig()
    before = rig.zoom.encoder.counts
    rig.zoom.report.put(before + 100_000, rig.now)
    rig.run(0.1)
    assert rig.zoom.encoder.counts == before and rig.zoom.encoder.sure
    assert rig.zoom.report.glitches.illegal == 1


def test_homing_by_a_key_pressed_twice_and_kept_for_tomorrow(tmp_path):
    rig = Rig(tmp_path, limits=None)
    for gear in rig.gears.values():
        gear.stops = (17_000, 23_000)
    status = rig.run(0.02, ["h"])
    assert rig.zoom.homing is None and "again" in status.notes[0]
    status = rig.run(0.02, ["h"])
    assert "homing" in status.axes[0].doing
    status = rig.run(12.0)
    assert [axis.homed for axis in status.axes] == [True, True]
    assert rig.zoom.motor.limits[1] == pytest.approx(5800, abs=10)
    assert status.axes[0].share > 0.8
    where_it_is = rig.zoom.encoder.counts
    rig.session.close(wait=lambda seconds: None)
    stored = json.loads((tmp_path / "positions.json").read_text())["encoders"]["zoom"]
    assert stored["counts"] == where_it_is and stored["sure"] and stored["at_rest"]
    again = PositionStore(tmp_path)
    assert again.get("zoom").limits == rig.zoom.motor.limits
    again.close()


def test_any_key_stops_homing():
    rig = Rig(limits=None)
    rig.run(0.02, ["h"])
    rig.run(0.02, ["h"])
    rig.run(1.0)
    assert speed(rig) < -0.2
    rig.run(0.02, ["x"])
    rig.run(0.2)
    assert (rig.zoom.homing.phase, rig.focus.homing.phase) == ("failed", "failed")
    assert rig.gears[1].power == rig.gears[2].power == 0


def test_the_end_stops_the_motors_whatever_is_held():
    rig = Rig()
    rig.adc.raw = [900, 900]
    rig.run(0.8)
    told = len(rig.controller.commands)

    def wait(seconds):
        rig.now += round(seconds * 1e9)
        rig.controller.advance()

    rig.session.close(wait=wait)
    assert [message.speed for _, message in rig.controller.commands[told:]] == [0] * 12
    assert abs(speed(rig)) < 0.01 and not rig.session.link.connected


def test_keys_of_a_terminal():
    assert keys_in("\x1b[C\x1b[Dq \x1bOA") == ["right", "left", "q", " ", "up"]
    assert keys_in("\x1b[15~h\x1b[1;5Ch") == ["h", "h"]  # F5, Ctrl-right
    assert keys_in("\x1b") == keys_in("\x1b[") == []


def shown(status):
    console = Console(file=io.StringIO(), width=100, force_terminal=False)
    console.print(screen(status, "title"))
    return console.file.getvalue()


def test_the_screen_says_what_the_operator_must_know(tmp_path):
    now = [0]
    session = open_simulated(RigFile(), tmp_path, clock=lambda: now[0])
    for _ in range(50):
        now[0] += STEP
        status = session.step()
    text = shown(status)
    assert "ends unknown" in text and "connected, framed lines" in text and "space  stop" in text
    assert [axis.name for axis in status.axes] == ["zoom", "focus", "pan", "tilt"]
    assert where(status.axes[2]).strip().endswith("°") and not status.axes[2].reading.glitches
    session.step(["0"])
    status = session.step(["0"])
    assert where(status.axes[2]).strip() in ("+0.00°", "-0.00°") and said(status.axes[2]) == ""
    session.close(wait=lambda seconds: None)
    rig = Rig()
    text = shown(rig.run(0.1))
    assert "50.0 %" in text and "●" in text and "ends unknown" not in text


def test_a_recorder_gets_the_counts_of_the_program_that_drives(tmp_path):
    now = [10**9]
    rig = RigFile()
    reader = SharedCounts("encoders", rig.encoders, folder=tmp_path, clock=lambda: now[0])
    assert reader.counts() == ()
    session = open_simulated(rig, tmp_path, clock=lambda: now[0])
    for _ in range(100):
        now[0] += STEP
        status = session.step(["right"])
    counts = reader.counts()
    assert counts == tuple(axis.reading.counts for axis in status.axes)
    assert counts[0] > 1000 and counts[2] != 0
    second = open_simulated(rig, tmp_path, clock=lambda: now[0])
    assert any("another program drives" in note for note in second.step().notes)
    second.close(wait=lambda seconds: None)
    assert reader.counts() == counts
    assert SharedCounts("encoders", {"zoom": 1}, folder=tmp_path, clock=lambda: now[0]).counts() == ()
    whole = (tmp_path / "counts.bin").read_bytes()
    (tmp_path / "counts.bin").write_bytes(whole[:-3] + b"abc")  # half written
    assert reader.counts() == ()
    (tmp_path / "counts.bin").write_bytes(whole)
    now[0] += 600_000_000  # it hangs
    assert reader.counts() == ()
    session.step()
    assert len(reader.counts()) == 4
    session.close(wait=lambda seconds: None)
    assert reader.counts() == ()


def test_a_real_rig_without_anything_plugged_in_waits(tmp_path, monkeypatch):
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [])
    session = open_session(RigFile(), tmp_path, clock=lambda: 0)
    status = session.step()
    assert "No microcontroller is plugged in" in status.link
    assert "encoders.pan.gpio" in shown(status)
    session.close(wait=lambda seconds: None)
    wrong = RigFile(encoders={"pan": EncoderPart(counts_per_turn=4000, gpio="no-such-chip 1 2")})
    session = open_session(wrong, tmp_path, clock=lambda: 0)
    assert "cannot be opened" in shown(session.step())
    session.close(wait=lambda seconds: None)


def test_numbers_of_motors():
    part = EncoderPart(counts_per_turn=100)
    assert motor_numbers(RigFile()) == {"zoom": 1, "focus": 2}
    assert motor_numbers(RigFile(encoders={"focus": part, "pan": part})) == {"focus": 2}
    twice = {name: part.model_copy(update={"motor": 3}) for name in ("zoom", "focus")}
    with pytest.raises(InputError, match="same motor"):
        motor_numbers(RigFile(encoders=twice))


@pytest.fixture
def command(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [])
    monkeypatch.setattr("acino_fte.cli_rig_drive._STATUS_S", 0.3)
    monkeypatch.chdir(tmp_path)
    app = typer.Typer()
    app.command("drive")(drive)
    return lambda *words: CliRunner().invoke(app, list(words))


def test_the_command(command, tmp_path, monkeypatch):
    found = command("--simulate", "--status")
    assert found.exit_code == 0 and "connected, framed lines" in found.output
    found = command("--status")
    assert found.exit_code == 1 and "No microcontroller" in found.output
    found = command("--simulate", "--calibrate-joystick")
    assert found.exit_code == 0 and (tmp_path / "acino-fte" / "rig-simulated" / "joystick.json").exists()
    monkeypatch.setattr(drive_setup, "find_adc", lambda: SimulatedAdc((500, 500)))
    (tmp_path / "acino-fte" / "rig").mkdir(exist_ok=True)
    (tmp_path / "acino-fte" / "rig" / "joystick.json").write_text("{")
    for words, text in (
        (["--simulate"], "this is none"),  # no terminal
        (["--simulate", "--port", "/dev/null"], "has no port"),
        (["--port", "/dev/no-such-port"], "no such serial port"),
        (["--status"], "--calibrate-joystick"),  # damaged calibration
        (["missing.yaml"], "missing.yaml"),
        (["--no-such-option"], "No such option"),
    ):
        found = command(*words)
        assert found.exit_code == 2 and text in found.output, words


@pytest.mark.parametrize("end", ["q", KeyboardInterrupt, OSError])
def test_however_the_command_ends_the_motors_stop(command, monkeypatch, end):
    """The key that quits, Ctrl-C, a terminal that is gone: in the middle of driving."""
    made = []

    class Controller(SimulatedController):
        def __init__(self, *words, **options):
            super().__init__(*words, **options)
            made.append(self)

    class Keys:
        turns = 0

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def read(self):
            self.turns += 1
            driven = made[0].motors[1].power > 0.1
            assert self.turns < 500
            if driven and end == "q":
                return ["q"]
            if driven:
                raise end
            return ["right"]

    monkeypatch.setattr(drive_setup, "SimulatedController", Controller)
    monkeypatch.setattr("acino_fte.rig.drive_keys.Keyboard", Keys)
    found = command("--simulate")
    assert found.exit_code == 0 and "The motors are stopped." in found.output
    assert all(motor.power == 0 for motor in made[0].motors.values())
    speeds = [message.speed for _, message in made[0].commands]
    assert max(speeds) > 80 and speeds[-6:] == [0] * 6
