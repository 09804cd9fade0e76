"""Motors: dead-man, ends of the travel, ramp, stall, wrong way, homing, H-bridge, by a simulated one."""

import pytest

from acino_fte.rig.encoders import Encoder, ReportedCounts
from acino_fte.rig.gpio import SimulatedBridge
from acino_fte.rig.motors import DEAD_MAN_S, HBridge, LinkOutput, MotorControl
from acino_fte.rig.motors_homing import Homing
from acino_fte.rig.motors_simulated import FULL_SPEED, SimulatedGearmotor

STEP_S = 0.02


class Bench:
    """A motor with its control, the encoder late by two turns of the loop, and a clock that is stepped."""

    def __init__(self, limits=(0, 9000), stops=(-100, 9100), start=4000, full_speed=FULL_SPEED):
        self.gear = SimulatedGearmotor(start, stops, full_speed)
        self.source = ReportedCounts()
        self.encoder = Encoder("zoom", self.source, 4741.44)
        self.motor = MotorControl(self.encoder, self.gear, limits=limits)
        self.late = [self.gear.counts] * 2
        self.now = 0
        self.powers = []
        self.turn()
        if limits:
            self.encoder.zero(start)

    def turn(self, wish=None):
        self.source.counts = self.late.pop(0)
        self.encoder.poll(self.now)
        if wish is not None:
            self.motor.command(wish, self.now)
        self.powers.append(self.motor.update(self.now))
        self.now += round(STEP_S * 1e9)
        self.gear.advance(STEP_S)
        self.late.append(self.gear.counts)

    def run(self, seconds, wish=None):
        for _ in range(round(seconds / STEP_S)):
            self.turn(wish)


def test_a_motor_stops_within_200_ms_of_the_last_command():
    for wish in (1.0, -1.0):
        bench = Bench(limits=(-(10**6), 10**6), stops=(-(10**6), 10**6))
        bench.run(1.0, wish)
        assert abs(bench.gear.speed) > 0.99 * FULL_SPEED
        bench.run(0.2 - STEP_S)  # the last command came with the last turn
        assert bench.gear.power == 0.0
        assert abs(bench.gear.speed) < 0.02 * FULL_SPEED
        place = bench.gear.position
        bench.run(1.0)
        assert abs(bench.gear.position - place) < 3  # 0.2° of the ring
    assert DEAD_MAN_S < 0.2


def test_the_ramp_is_for_speeding_up_only():
    bench = Bench(limits=(-(10**6), 10**6), stops=(-(10**6), 10**6))
    bench.run(0.5, 1.0)
    rises = [after - before for before, after in zip(bench.powers, bench.powers[1:], strict=False)]
    assert max(rises) <= STEP_S / 0.25 + 1e-9
    assert bench.powers[-1] == 1.0
    bench.turn(0.3)
    assert bench.powers[-1] == 0.3  # slower at once
    bench.turn(-1.0)
    assert -0.09 < bench.powers[-1] < 0  # turning round begins from zero
    bench.turn(0.0)
    assert bench.powers[-1] == 0.0


@pytest.mark.parametrize("wish", [1.0, -1.0, 0.4])
def test_it_stops_at_the_ends_of_the_travel(wish):
    bench = Bench(stops=(-(10**6), 10**6))
    bench.run(6.0, wish)
    assert -100 < bench.gear.position < 9100  # the margin that homing keeps
    assert bench.gear.speed == pytest.approx(0, abs=1)
    assert bench.motor.fault == ""
    bench.run(0.5, -wish)  # back is free
    assert 500 < bench.gear.position < 8700


def test_without_known_ends_it_is_slow():
    bench = Bench(limits=None)
    bench.run(0.5, 1.0)
    assert max(bench.powers) == 0.3
    bench = Bench()
    bench.encoder.sure = False
    bench.run(0.5, -1.0)
    assert min(bench.powers) == -0.3
    assert not bench.motor.homed


def test_a_stalled_motor_is_switched_off_until_the_operator_lets_go():
    bench = Bench()
    bench.run(0.3, 0.5)
    bench.gear.jammed = True
    bench.run(0.8, 0.5)
    assert bench.motor.fault == "stalled"
    assert bench.powers[-1] == 0.0
    bench.run(1.0, 0.5)
    assert bench.powers[-1] == 0.0  # not again while it is held
    bench.gear.jammed = False
    bench.run(0.3, -0.5)
    assert bench.motor.fault == "" and bench.powers[-1] == -0.5  # away from it is free
    bench.turn(0.0)
    bench.run(0.5, 0.5)
    assert bench.powers[-1] == 0.5


def test_swapped_wires_are_found_before_the_ring_meets_its_stop():
    bench = Bench(start=1000, full_speed=-FULL_SPEED)
    bench.run(1.0, 1.0)
    assert bench.motor.fault == "turns the wrong way"
    assert bench.gear.position > 500
    bench.run(0.5, 1.0)
    assert bench.powers[-1] == 0.0


def test_homing_finds_both_ends():
    bench = Bench(limits=None, stops=(-3210, 5790), start=1111)
    homing = Homing(bench.motor, bench.now)
    while homing.under_way:
        homing.step(bench.now)
        bench.turn()
    assert homing.phase == "done"
    low, high = bench.motor.limits
    assert low == 0 and high == pytest.approx(9000 - 200, abs=5)  # less the margins
    assert bench.motor.homed
    bench.run(0.5)
    assert bench.encoder.counts == pytest.approx(bench.gear.position + 3210 - 100, abs=2)
    assert 0 <= bench.encoder.counts <= high
    bench.run(8.0, 1.0)
    assert bench.gear.position < 5790  # the ring no longer meets its stop


def test_homing_gives_up():
    bench = Bench(limits=None, stops=(-(10**6), 10**6))
    homing = Homing(bench.motor, bench.now)
    while homing.under_way:
        homing.step(bench.now)
        bench.turn()
        assert bench.now < 70e9
    bench.run(0.3)
    assert (homing.phase, bench.motor.limits, bench.gear.power) == ("failed", None, 0.0)
    bench = Bench(limits=None)
    bench.gear.jammed = True
    homing = Homing(bench.motor, bench.now)
    while homing.under_way:
        homing.step(bench.now)
        bench.turn()
    assert homing.phase == "failed"  # no travel between the ends


def test_the_bridge_brakes_before_it_turns_round():
    pins = SimulatedBridge()
    bridge = HBridge(pins)
    for power in (0.5, 0.7, -0.2, 0.0, 2.0):
        bridge.set(power)
    bridge.close()
    assert pins.told == [
        *((True, 0.5), (True, 0.7)),
        *((True, 0.0), (False, 0.2)),
        (False, 0.0),
        *((False, 0.0), (True, 1.0)),
        *((True, 0.0), (True, 0.0)),
    ]


def test_power_becomes_the_speed_of_the_protocol():
    output = LinkOutput(1)
    speeds = []
    for power in (0, 1, -1, 0.5, -0.25, 7, -7):
        output.set(power)
        speeds.append(output.speed)
    assert speeds == [0, 800, -800, 400, -200, 800, -800]
