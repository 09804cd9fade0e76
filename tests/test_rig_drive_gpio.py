"""Pins: gpiod's events (a stand-in for the kernel), gpiozero's mock pins, the simulator."""

import numpy as np
import pytest
from gpiozero.pins.mock import MockFactory, MockPWMPin

from acino_fte.errors import InputError
from acino_fte.rig.gpio import GpiodEdges, GpiozeroBridge, GpiozeroEdges, SimulatedEdges, open_edges
from acino_fte.rig.quadrature import EdgeDecoder, edges_of

gpiod = pytest.importorskip("gpiod")  # Linux only
RISING, FALLING = (kind.value for kind in gpiod.EdgeEvent.Type)


class Kernel:
    """What gpiod.request_lines gives: a queue of events."""

    def __init__(self, levels, batches):
        self.levels, self.batches, self.released = levels, batches, False

    def get_values(self, lines):
        return [gpiod.line.Value(int(level)) for level in self.levels]

    def wait_edge_events(self, timeout):
        assert timeout == 0  # never waits
        return bool(self.batches)

    def read_edge_events(self):
        return self.batches.pop(0)

    def release(self):
        self.released = True


def kernel_events(edges, offsets, first_number=1):
    return [
        gpiod.EdgeEvent(RISING if level else FALLING, int(time), offsets[line], first_number + k, 0)
        for k, (time, line, level) in enumerate(zip(*edges, strict=True))
    ]


def test_gpiod_events_become_counts(monkeypatch):
    position = np.concatenate([np.arange(1, 200), np.arange(198, -50, -1)])
    edges, levels = edges_of(position, 1000 * np.arange(len(position)))
    events = kernel_events(edges, (17, 27))
    kernel = Kernel(levels, [events[:100], events[100:300], events[300:]])
    asked = {}

    def request_lines(path, config, **rest):
        asked.update(path=path, config=config, **rest)
        return kernel

    monkeypatch.setattr(gpiod, "request_lines", request_lines)
    lines = open_edges("gpiochip1 17 27")
    assert asked["path"] == "/dev/gpiochip1"
    (settings,) = asked["config"].values()
    assert settings.edge_detection == gpiod.line.Edge.BOTH
    assert settings.event_clock == gpiod.line.Clock.MONOTONIC
    decoder = EdgeDecoder(lines.levels)
    batch = lines.read()
    decoder.feed(batch.edges, batch.until_ns)
    assert (decoder.position, batch.lost) == (-49, 0)
    kernel.batches = [kernel_events(edges, (17, 27), first_number=len(events) + 6)]
    assert lines.read().lost == 5
    lines.close()
    assert kernel.released


def test_a_line_that_oscillates_does_not_hold_up_the_loop(monkeypatch):
    edges, levels = edges_of(np.array([1]), np.array([5]))
    kernel = Kernel(levels, [kernel_events(edges, (1, 2))] * 1000)
    monkeypatch.setattr(gpiod, "request_lines", lambda *_, **__: kernel)
    GpiodEdges("gpiochip0", [1, 2]).read()
    assert len(kernel.batches) > 900


@pytest.mark.parametrize("text", ["", "gpiochip0", "gpiochip0 1", "gpiochip0 1 x", "gpiochip0 1 2 3 4"])
def test_wrong_descriptions_of_lines(text):
    with pytest.raises(InputError, match="not understood"):
        open_edges(text)


def test_lines_that_are_not_there():
    with pytest.raises(InputError, match="gpioinfo"):
        open_edges("no-such-chip 1 2")


def test_mock_pins_of_gpiozero_become_counts():
    factory = MockFactory()
    a, b = factory.pin(5), factory.pin(6)
    lines = GpiozeroEdges([5, 6], factory)
    decoder = EdgeDecoder(lines.levels)
    for change in [a.drive_high, b.drive_high, a.drive_low, b.drive_low, a.drive_high, a.drive_low]:
        change()
    batch = lines.read()
    decoder.feed(batch.edges)
    decoder.flush()
    assert decoder.position == 4
    assert not decoder.glitches.repeated
    lines.close()


def test_phase_and_enable_of_gpiozero():
    factory = MockFactory(pin_class=MockPWMPin)
    bridge = GpiozeroBridge(20, 21, factory)
    bridge.set(True, 0.25)
    assert (factory.pin(20).state, factory.pin(21).state) == (0, 0.25)
    bridge.set(False, 0.5)
    assert (factory.pin(20).state, factory.pin(21).state) == (1, 0.5)
    bridge.close()
    assert factory.pin(21).state == 0


def test_simulated_edges_are_given_once():
    lines = SimulatedEdges(clock=lambda: 100)
    lines.push(edges_of(np.array([1, 2]), np.array([10, 20]))[0])
    assert lines.read().edges.time_ns.tolist() == [10, 20]
    assert len(lines.read().edges.time_ns) == 0
