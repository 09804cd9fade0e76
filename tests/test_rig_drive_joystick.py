"""The joystick: calibration, dead band, curve, filter, broken wires, its file."""

import json

import gpiozero
import numpy as np
import pytest
from gpiozero.pins.mock import MockFactory

from acino_fte.errors import InputError
from acino_fte.rig.joystick import Axis, GpiozeroAdc, IioAdc, Joystick, Response, SimulatedAdc, find_adc
from acino_fte.rig.joystick_calibration import (
    FORMAT,
    AxisCalibration,
    calibrated,
    load_calibration,
    save_calibration,
)

STEP = 20_000_000
CALIBRATION = AxisCalibration(100, 500, 1000)


def held(axis, raw, n=30, start=0):
    return [axis.update(raw, (start + k) * STEP) for k in range(n)][-1]


def test_calibrated_places_are_the_ends_and_the_middle():
    assert [CALIBRATION.deflection(raw) for raw in (100, 300, 500, 750, 1000)] == [-1, -0.5, 0, 0.5, 1]
    upside_down = AxisCalibration(1000, 500, 100)
    assert [upside_down.deflection(raw) for raw in (100, 500, 1000)] == [1, 0, -1]
    for low, centre, high in ((100, 90, 1000), (100, 120, 1000), (500, 500, 500)):
        with pytest.raises(InputError, match="calibrate again"):
            AxisCalibration(low, centre, high)


def test_dead_band_and_curve():
    response = Response(dead_band=0.1, expo=0.6)
    assert response(0.1) == response(-0.0999) == 0.0
    assert 0 < response(0.101) < 0.001  # no step at its edge
    assert (response(1.0), response(-1.0), response(3.0)) == (1.0, -1.0, 1.0)
    x = np.linspace(-1, 1, 401)
    y = np.array([response(value) for value in x])
    assert np.all(np.diff(y) >= 0)
    np.testing.assert_allclose(y, -y[::-1], atol=1e-12)
    assert response(0.55) == pytest.approx(0.4 * 0.5 + 0.6 * 0.125)
    assert Response(dead_band=0.0, expo=0.0)(0.3) == pytest.approx(0.3)
    with pytest.raises(InputError, match="impossible"):
        Response(dead_band=1.0)


def test_filter_takes_out_single_readings_and_lets_go_at_once():
    axis = Axis(CALIBRATION)
    held(axis, 500)
    assert axis.update(1000, 31 * STEP) == 0.0  # one wrong reading
    assert axis.update(500, 32 * STEP) == 0.0
    assert held(axis, 1000, start=33) == pytest.approx(1.0, abs=1e-3)
    axis.update(500, 63 * STEP)
    assert axis.update(500, 64 * STEP) == 0.0  # one reading later
    rng = np.random.default_rng(0)
    noisy = [axis.update(900 + int(rng.normal(0, 20)), (65 + k) * STEP) for k in range(200)][20:]
    plain = [axis.response(CALIBRATION.deflection(900 + int(rng.normal(0, 20)))) for _ in range(180)]
    assert np.std(noisy) < 0.6 * np.std(plain)


def test_a_broken_wire_and_a_stick_that_is_held_over_want_nothing():
    adc = SimulatedAdc((1000, 500))
    stick = Joystick(adc, [Axis(CALIBRATION), Axis(CALIBRATION)])

    def read(n=10):
        for _ in range(n):
            read.now += STEP
            wanted = stick.read(read.now)
        return wanted

    read.now = 0
    assert read() == (0.0, 0.0)  # held over since the beginning
    assert "let go" in stick.trouble
    adc.raw = [500, 500]
    read()
    adc.raw = [1000, 500]
    assert read(20)[0] == pytest.approx(1.0, abs=0.01)
    adc.raw = [1000, 4095]
    assert read() == (0.0, 0.0)
    assert "axis 2 is broken" in stick.trouble
    adc.raw = [1000, 500]
    assert read() == (0.0, 0.0)  # not before it was in the middle
    adc.raw = [500, 500]
    assert read() == (0.0, 0.0)
    assert stick.trouble == ""
    adc.raw = [500, 100]
    assert read(20)[1] == pytest.approx(-1.0, abs=0.01)
    stick.disarm()
    assert read() == (0.0, 0.0)


def test_a_converter_that_cannot_be_read():
    class Gone:
        def read(self):
            raise OSError(5, "Input/output error")

    stick = Joystick(Gone(), [Axis(CALIBRATION)])
    assert stick.read(0) is None
    assert "cannot be read: Input/output error" in stick.trouble


def test_the_kernels_converter(tmp_path):
    assert find_adc(tmp_path) is None
    folder = tmp_path / "iio:device0"
    folder.mkdir()
    for channel, raw in enumerate((501, 777)):
        (folder / f"in_voltage{channel}_raw").write_text(f"{raw}\n")
    assert find_adc(tmp_path).read() == (501, 777)
    (folder / "in_voltage1_raw").write_text("\n")
    with pytest.raises(OSError, match="not a number"):
        IioAdc(folder).read()
    assert find_adc(tmp_path / "missing") is None


def test_a_mcp3008_that_is_not_there_is_a_broken_wire(monkeypatch):
    """gpiozero's mock pins have no chip behind them and give zeros."""
    monkeypatch.setattr(gpiozero.Device, "pin_factory", MockFactory())
    raw = GpiozeroAdc().read()
    assert raw == (0, 0)
    axis = Axis(AxisCalibration(100, 500, 1000))
    held(axis, raw[0])
    assert axis.broken


def test_calibration_is_measured_saved_and_read(tmp_path):
    rng = np.random.default_rng(1)
    rest = [(510 + int(rng.integers(-2, 3)), 498) for _ in range(50)]
    turn = np.linspace(0, 4 * np.pi, 200)
    moved = [(round(510 + 400 * np.cos(t)), round(498 + 450 * np.sin(t))) for t in turn] + [(4095, 0)]
    axes = calibrated(rest, moved)
    assert abs(axes[0].centre - 510) <= 1
    assert axes[0].high == pytest.approx(910, abs=2)  # the one wrong reading is no end
    assert axes[1].low == pytest.approx(48, abs=2)
    save_calibration(tmp_path, axes)
    assert load_calibration(tmp_path) == axes
    assert load_calibration(tmp_path / "none") is None
    with pytest.raises(InputError, match="not moved to both ends"):
        calibrated(rest, [(510, 498)] * 100)
    with pytest.raises(InputError, match="moved while it was to rest"):
        calibrated(moved, moved)
    with pytest.raises(InputError, match="too few"):
        calibrated([], moved)


@pytest.mark.parametrize(
    "content",
    ["", "{", "[1]", {"axes": []}, {"axes": [{"low": 1, "centre": 2}]}, {"axes": [{"low": "a"}] * 2}],
)
def test_a_damaged_calibration_is_told(tmp_path, content):
    text = content if isinstance(content, str) else json.dumps({"format": FORMAT, **content})
    (tmp_path / "joystick.json").write_text(text)
    with pytest.raises(InputError, match=r"joystick\.json"):
        load_calibration(tmp_path)
