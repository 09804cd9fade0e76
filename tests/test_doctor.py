"""``acino-fte doctor``: every check tells a failure that is put before it, and what to do about it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import tomllib
from contextlib import nullcontext
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from typer.testing import CliRunner

from acino_fte import (
    cli_doctor,
    doctor,
    doctor_ask,
    doctor_devices,
    doctor_machine,
    doctor_packages,
    doctor_probe,
    doctor_storage,
)
from acino_fte.doctor import Finding, Surroundings, all_checks, examine, looked, ready
from acino_fte.doctor_ask import Answer, asked

REPOSITORY = Path(__file__).resolve().parent.parent
NAMES = [check.name for check in all_checks()]
IPOPT = {"version": "3.14.11", "wrapper": "1.7", "status": 0, "message": "solved", "error": 1e-8}
WELL = {
    "ipopt": Answer(IPOPT),
    "explicit": Answer({"route": "casadi", "file": "", "error": 1e-8}),
    "threads": Answer({"blas": "openblas", "version": "0.3", "threads": 1}),
    "codecs": Answer({"works": ["libx264"], "faults": {}}),
    "serial": Answer({"ports": []}),
    "gpio": Answer({"chips": []}),
    "devices": Answer({"file": "", "devices": {}, "faults": [], "remedy": ""}),
}
BROKEN = Answer(fault="ImportError: libstrange.so: cannot open shared object file")


def look(
    name: str, tmp_path: Path, answers: dict[str, Answer] | None = None, path: Path | None = None
) -> Finding:
    """What a check finds, with a root of its own and the answers of a healthy computer elsewhere."""
    check = next(check for check in all_checks() if check.name == name)
    finding = looked(check, Surroundings(path or tmp_path, tmp_path, WELL | (answers or {})))
    assert finding.remedy or finding.state == "ok", finding
    assert "\n" not in finding.found + finding.remedy
    return finding


@pytest.fixture
def well(monkeypatch):
    """The answers of a healthy computer, at once; give others to change them."""

    def use(answers: dict[str, Answer] | None = None) -> None:
        monkeypatch.setattr(doctor, "asked", lambda: nullcontext(WELL | (answers or {})))

    monkeypatch.setattr(doctor_storage, "write_speed", lambda *_: 500.0)
    use()
    return use


alone = typer.Typer()  # the whole program is built anew for every call, which takes longer than the checks
alone.command()(cli_doctor.doctor)


def run(*words: str):
    return CliRunner(env={"COLUMNS": "300"}).invoke(alone, words)


# The command


def test_a_healthy_computer_is_ready_on_one_screen(well, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run()
    assert done.exit_code == 0, done.output
    assert len(done.stdout.splitlines()) <= 24 + 6  # 24 lines, and remedies of what this computer has not
    assert "run: ready" in done.stdout


def test_a_failure_counts_where_it_matters(well, tmp_path):
    well({"import:gpiod": BROKEN})
    found = {purpose: run("--for", purpose, "--path", str(tmp_path)) for purpose in ("run", "lidar", "rig")}
    assert [done.exit_code for done in found.values()] == [0, 0, 1]
    assert re.search(
        r"^-- +extra rig .*gpiod .* is broken: ImportError: libstrange", found["run"].stdout, re.M
    )
    assert re.search(r"^FAIL +extra rig ", found["rig"].stdout, re.M)
    assert "not ready for rig: extra rig" in found["rig"].stdout
    assert "> pip install" in found["run"].stdout


def test_json_is_for_programs(well, tmp_path):
    well({"ipopt": BROKEN})
    done = run("--json", "--path", str(tmp_path))
    assert done.exit_code == 1
    content = json.loads(done.stdout)
    assert content["format"] == doctor.FORMAT
    assert content["works"] is False
    assert content["ready"] == {"run": False, "lidar": False, "rig": True}
    assert [check["name"] for check in content["checks"]] == NAMES
    ipopt = content["checks"][NAMES.index("ipopt")]
    assert (ipopt["state"], ipopt["matters_for"]) == ("failed", ["lidar", "run"])
    assert "libstrange" in ipopt["found"]
    assert ipopt["remedy"]


@pytest.mark.parametrize(
    "words", [("--for", "rigg"), ("--path", "nowhere"), ("--path", __file__), ("--jsn",)]
)
def test_a_wrong_word_is_wrong_input(words, well):
    done = run(*words)
    assert done.exit_code == 2
    assert "Traceback" not in done.output


@pytest.mark.parametrize("name", NAMES)
def test_a_check_that_breaks_does_not_stop_the_others(name, well, tmp_path, monkeypatch):
    def break_down(around):
        raise ZeroDivisionError("on purpose")

    checks = [
        doctor.Check(
            c.name, c.title, c.matters, break_down if c.name == name else lambda _: Finding("ok", "")
        )
        for c in all_checks()
    ]
    findings = list(examine(tmp_path, checks=checks))
    assert [f.name for f in findings] == NAMES
    assert [f.name for f in findings if f.state == "failed"] == [name]
    broken = findings[NAMES.index(name)]
    assert "ZeroDivisionError: on purpose" in broken.found
    assert broken.remedy
    needed = next(c.matters for c in all_checks() if c.name == name)
    assert [p for p, able in ready(findings).items() if not able] == [
        p for p in doctor.PURPOSES if p in needed
    ]


def test_it_starts_where_numpy_and_others_are_broken(tmp_path):
    """NumPy and the like may be broken: the doctor is who tells."""
    broken = ("numpy", "scipy", "pyomo", "casadi", "pandas", "xarray", "matplotlib", "h5netcdf")
    broken += ("cv2", "pypcd4", "pycolmap", "nicegui", "serial", "gpiod", "av", "gpiozero", "rosbags")
    for name in broken:
        (tmp_path / f"{name}.py").write_text("raise ImportError('on purpose')")
    code = "from acino_fte.cli import main; main()"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(REPOSITORY)])}
    done = subprocess.run(
        [sys.executable, "-c", code, "doctor", "--for", "rig", "--json"],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    checks = {check["name"]: check for check in json.loads(done.stdout)["checks"]}
    assert checks["ipopt"]["state"] == "failed"
    assert re.search(r"numpy [\d.]+ is broken: ImportError: on purpose", checks["packages"]["found"])
    assert "on purpose" in checks["rig"]["found"]
    assert not [c["name"] for c in checks.values() if "the check itself broke" in c["found"]]
    assert not [c["name"] for c in checks.values() if c["state"] == "failed" and not c["remedy"]]


# Probes in processes of their own


def test_probes_that_crash_or_hang_lose_only_their_own_answer(tmp_path, monkeypatch):
    (tmp_path / "crashing.py").write_text("import os\nos.abort()")
    (tmp_path / "leaving.py").write_text("import os\nos._exit(3)")
    (tmp_path / "hanging.py").write_text("import time\ntime.sleep(60)")
    (tmp_path / "chatting.py").write_text("import os\nprint('hello')\nos.write(1, b'hello')")
    (tmp_path / "raising.py").write_text("raise OSError('no such library\\nand more')")
    monkeypatch.syspath_prepend(tmp_path)
    names = ["crashing", "chatting", "raising", "json", "leaving", "hanging"]
    begun = time.monotonic()
    with asked([[f"import:{name}" for name in names], ["nonsense"]], patience=2.0) as answers:
        faults = {name: answers[f"import:{name}"].fault for name in names}
        assert "KeyError" in answers["nonsense"].fault
    assert time.monotonic() - begun < 30.0
    assert faults == {
        "crashing": "crashed (SIGABRT)" if os.name == "posix" else faults["crashing"],
        "chatting": "",
        "raising": "OSError: no such library",
        "json": "",
        "leaving": "the program ended (exit code 3)",
        "hanging": "no answer within 2 s",
    }


def test_no_process_can_be_started(monkeypatch):
    monkeypatch.setattr(doctor_ask.sys, "executable", "/no/such/python")
    with asked([["ipopt", "threads"]]) as answers:
        assert "cannot be tried" in answers["ipopt"].fault
        assert "cannot be tried" in answers["threads"].fault


def test_a_file_in_the_current_folder_is_not_taken_for_a_package(tmp_path, monkeypatch):
    (tmp_path / "colorsys.py").write_text("raise ImportError('mine')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    with asked([["import:colorsys"]]) as answers:
        assert answers["import:colorsys"] == Answer(answers["import:colorsys"].value, "")


def test_every_package_is_probed_that_a_finding_is_about():
    probed = {name for names in doctor_ask.WORKERS for name in names}
    for extra, packages in doctor_packages.EXTRAS.items():
        assert {f"import:{p.module}" for p in packages} <= probed, extra
    assert set(doctor_probe.PROBES) <= probed
    assert len(probed) == sum(len(names) for names in doctor_ask.WORKERS)


# Solvers


def test_ipopt_really_solves_here():
    found = doctor_probe.probe("ipopt")
    assert found["status"] == 0
    assert found["error"] < 1e-5


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (BROKEN, "libstrange"),
        (Answer(fault="crashed (SIGSEGV)"), "SIGSEGV"),
        (Answer(IPOPT | {"status": -12, "message": "Invalid option"}), "Invalid option"),
        (Answer(IPOPT | {"error": 0.3}), "came out wrong"),
        (Answer(IPOPT | {"error": float("nan")}), "came out wrong"),
    ],
)
def test_ipopt_that_fails(answer, words, tmp_path):
    finding = look("ipopt", tmp_path, {"ipopt": answer})
    assert finding.stops("run")
    assert finding.stops("lidar")
    assert words in finding.found
    assert "cyipopt-wheels" in finding.remedy


def test_an_ipopt_program_that_is_broken_is_named(tmp_path, monkeypatch):
    """It comes first in the explicit model's routes, so a broken one is in the way."""
    program = tmp_path / "ipopt"
    program.write_text('#!/bin/sh\ncase "$1" in -v) echo "Ipopt 3.14.1";; *) exit 9;; esac\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    import pyomo.common

    pyomo.common.Executable("ipopt").rehash()
    try:
        with pytest.raises(RuntimeError, match=re.escape(str(program))) as error:
            doctor_probe.probe("explicit")
    finally:
        monkeypatch.undo()
        pyomo.common.Executable("ipopt").rehash()
    finding = look("explicit", tmp_path, {"explicit": Answer(fault=str(error.value))})
    assert finding.state == "failed"
    assert "off the PATH" in finding.remedy
    assert not any(finding.stops(purpose) for purpose in doctor.PURPOSES)


def test_the_explicit_route_that_is_wrong_or_broken(tmp_path):
    wrong = Answer({"route": "ipopt", "file": "/opt/ipopt", "error": 1.0})
    assert "/opt/ipopt" in look("explicit", tmp_path, {"explicit": wrong}).found
    broken = look("explicit", tmp_path, {"explicit": BROKEN})
    assert "casadi" in broken.remedy
    assert "--lowering" in broken.remedy


def test_threads_of_blas(tmp_path, monkeypatch):
    assert doctor_probe.probe("threads")["blas"]
    many = Answer({"blas": "openblas", "version": "0.3", "threads": 4096})
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "4096")
    finding = look("threads", tmp_path, {"threads": many})
    assert finding.state == "note"
    assert "OPENBLAS_NUM_THREADS" in finding.remedy
    assert look("threads", tmp_path, {"threads": BROKEN}).state == "note"


# Packages


def test_packages_are_those_of_pyproject():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {name: project["optional-dependencies"][name] for name in doctor_packages.EXTRAS}
    for packages, lines in [
        (doctor_packages.CORE, project["dependencies"]),
        *((doctor_packages.EXTRAS[name], lines) for name, lines in extras.items()),
    ]:
        wanted = {re.split("[>=;]", line)[0]: re.search(r"[>=]=([\w.]+)", line)[1] for line in lines}
        assert {p.name: p.least for p in packages} == wanted
    low, high = re.match(r">=(.+),<(.+)", project["requires-python"]).groups()
    assert [tuple(map(int, text.split("."))) for text in (low, high)] == list(doctor_packages.PYTHON)


def test_a_core_package_that_is_missing_old_or_broken(tmp_path, monkeypatch):
    real = metadata.version

    def version(name):
        if name in ("sympy", "plyfile"):
            raise metadata.PackageNotFoundError(name)
        return "1.2.3rc1" if name == "scipy" else real(name)

    monkeypatch.setattr(doctor_packages.metadata, "version", version)
    monkeypatch.setattr(doctor_packages, "find_spec", lambda name: None if name == "sympy" else object())
    finding = look("packages", tmp_path, {"import:pandas": BROKEN})
    assert [finding.stops(p) for p in doctor.PURPOSES] == [True, True, True]
    assert "sympy is missing" in finding.found
    assert "plyfile" not in finding.found  # without a record of its version, but there
    assert "scipy 1.2.3rc1 is older than 1.11" in finding.found
    assert "pandas" in finding.found
    assert "libstrange" in finding.found
    assert finding.remedy


def test_a_python_that_is_too_new(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor_packages, "sys", SimpleNamespace(version_info=(3, 19, 0)))
    finding = look("packages", tmp_path)
    assert finding.state == "failed"
    assert "3.13" in finding.remedy


@pytest.mark.parametrize("extra", list(doctor_packages.EXTRAS))
def test_an_extra_that_is_missing_in_part_or_broken(extra, tmp_path, monkeypatch):
    if extra == "rig":
        monkeypatch.setattr(doctor_packages.platform, "system", lambda: "Linux")
    last = doctor_packages.EXTRAS[extra][-1]
    healthy = {"state": "ok", "remedy": ""}
    versions = {p.name: "99.0" for p in doctor_packages.EXTRAS[extra]}

    def version(name):
        if name not in versions:
            raise metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(doctor_packages.metadata, "version", version)
    monkeypatch.setattr(doctor_packages, "find_spec", lambda name: None)
    finding = look(extra, tmp_path)
    assert {"state": finding.state, "remedy": finding.remedy} == healthy
    assert f"{last.name} 99.0" in finding.found

    broken = look(extra, tmp_path, {f"import:{last.module}": Answer(fault="crashed (SIGSEGV)")})
    assert f"{last.name} 99.0 is broken: crashed (SIGSEGV)" in broken.found
    assert "\n" not in broken.found
    assert f'--force-reinstall "acino-fte[{extra}]"' in broken.remedy
    assert [p for p in doctor.PURPOSES if broken.stops(p)] == ([extra] if extra != "colmap" else [])

    versions[last.name] = "0.1"
    assert f"{last.name} 0.1 is older than {last.least}" in look(extra, tmp_path).found
    del versions[last.name]
    missing = look(extra, tmp_path)
    assert (f"{last.name} is missing" in missing.found) or extra == "colmap"
    versions.clear()
    assert look(extra, tmp_path).found == "not installed"
    assert look(extra, tmp_path).remedy == f'pip install "acino-fte[{extra}]"'


# Devices


def test_encoders_really_encode_here(tmp_path):
    pytest.importorskip("av")
    found = doctor_probe.probe("codecs")
    assert "libx264" in found["works"]
    assert set(found["works"]) | set(found["faults"]) == {"libx264", *doctor_probe.HARDWARE_H264}
    assert look("codecs", tmp_path, {"codecs": Answer(found)}).state == "ok"


def test_encoders_that_fail(tmp_path, monkeypatch):
    without = look(
        "codecs", tmp_path, {"codecs": Answer({"works": ["h264_nvenc"], "faults": {"libx264": "gone"}})}
    )
    assert without.stops("rig")
    assert without.stops("lidar")
    assert "libx264 does not work: gone" in without.found
    assert look("codecs", tmp_path, {"codecs": BROKEN}).remedy
    named = look("codecs", tmp_path, {"codecs": Answer({"works": ["libx264", "h264_nvenc"], "faults": {}})})
    assert "hardware: h264_nvenc" in named.found
    monkeypatch.setattr(doctor_probe, "_encode", lambda name: [])
    pytest.importorskip("av")
    assert "libx264" in doctor_probe.probe("codecs")["faults"]  # pictures that cannot be read again


def test_the_encoders_tried_are_those_that_the_recorder_takes():
    from acino_fte.rig.writers_video import HARDWARE, SOFTWARE

    assert doctor_probe.HARDWARE_H264 == HARDWARE
    assert SOFTWARE == "libx264"


def test_local_pages(tmp_path, monkeypatch):
    assert look("page", tmp_path).state == "ok"

    def refuse(*_args, **_kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(doctor_devices.socket, "create_server", refuse)
    finding = look("page", tmp_path)
    assert finding.stops("lidar")
    assert "Permission denied" in finding.found
    assert "127.0.0.1" in finding.remedy


def port(device: Path | str, *, usb: bool = True) -> Answer:
    return Answer({"ports": [{"device": str(device), "what": "Teensy", "usb": usb}]})


def test_serial_ports(tmp_path, monkeypatch):
    pytest.importorskip("serial")
    assert "ports" in doctor_probe.probe("serial")
    nothing = look("serial", tmp_path, {"serial": port("/dev/ttyS0", usb=False)})
    assert nothing.state == "note"  # every PC has that one, with nothing on it
    assert "microcontroller" in nothing.remedy
    assert look("serial", tmp_path, {"serial": port("/dev/ttyACM0")}).state in ("ok", "failed")
    monkeypatch.setattr(doctor_devices.os, "access", lambda *_: True)
    assert "/dev/ttyUSB0 (Teensy)" in look("serial", tmp_path, {"serial": port("/dev/ttyUSB0")}).found
    monkeypatch.setattr(doctor_devices.os, "access", lambda *_: False)
    closed = look("serial", tmp_path, {"serial": port("/dev/ttyUSB0")})
    assert closed.stops("rig")
    assert "no permission for /dev/ttyUSB0" in closed.found
    assert "usermod -aG dialout $USER" in closed.remedy
    assert look("serial", tmp_path, {"serial": BROKEN}).remedy


def test_a_session_older_than_the_group_is_told_to_log_in_again(tmp_path, monkeypatch):
    grp, pwd = pytest.importorskip("grp"), pytest.importorskip("pwd")
    device = tmp_path / "ttyACM0"
    device.touch()
    group = SimpleNamespace(gr_gid=54321, gr_name="uucp", gr_mem=["me"])
    monkeypatch.setattr(grp, "getgrgid", lambda _: group)
    monkeypatch.setattr(pwd, "getpwuid", lambda _: SimpleNamespace(pw_name="me"))
    assert "log out and in again" in doctor_devices._permission(str(device), "dialout")
    monkeypatch.setattr(pwd, "getpwuid", lambda _: SimpleNamespace(pw_name="other"))
    assert "usermod -aG uucp" in doctor_devices._permission(str(device), "dialout")


def test_gpio(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor_devices.platform, "system", lambda: "Linux")
    assert look("gpio", tmp_path).state == "note"
    chip = {"device": "/dev/gpiochip0", "label": "soc", "lines": 54, "fault": ""}
    assert "gpiochip0 (54 lines)" in look("gpio", tmp_path, {"gpio": Answer({"chips": [chip]})}).found
    closed = look("gpio", tmp_path, {"gpio": Answer({"chips": [chip | {"fault": "Permission denied"}]})})
    assert closed.stops("rig")
    assert "usermod -aG gpio" in closed.remedy
    assert look("gpio", tmp_path, {"gpio": BROKEN}).stops("rig")
    monkeypatch.setattr(doctor_devices.platform, "system", lambda: "Darwin")
    assert look("gpio", tmp_path, {"gpio": BROKEN}).state == "note"


def devices_here(tmp_path) -> Finding:
    """Of the rig.yaml in the current folder."""
    return look("devices", tmp_path, {"devices": Answer(doctor_probe.probe("devices"))})


def test_drivers_of_the_rig_here(tmp_path, monkeypatch):
    from acino_fte.rig import sources

    monkeypatch.chdir(tmp_path)
    without = devices_here(tmp_path)
    assert without.state == "note"
    assert "rig plan --init" in without.remedy
    file = tmp_path / "rig.yaml"
    file.write_text("format: acino-fte/rig/1\n")
    assert "simulated: cam1, lidar1" in devices_here(tmp_path).found
    file.write_text("format: acino-fte/rig/1\ncameras:\n  cam1: {device: ximea}\nlidars: {}\n")
    missing = devices_here(tmp_path)
    assert missing.stops("rig")
    assert "cameras.cam1.device: ximea" in missing.found
    monkeypatch.setitem(sources.DRIVERS, "ximea", lambda name, part: None)
    assert devices_here(tmp_path).found == "cam1: ximea"
    file.write_text("format: acino-fte/rig/1\ncameras: 3\n")
    assert devices_here(tmp_path).stops("rig")

    def broken(*_):
        raise OSError("libm3api.so.2: cannot open shared object file")

    file.write_text("format: acino-fte/rig/1\ncameras:\n  cam1: {device: ximea}\nlidars: {}\n")
    monkeypatch.setattr(sources, "find_driver", broken)
    assert "libm3api" in devices_here(tmp_path).found
    assert look("devices", tmp_path, {"devices": BROKEN}).stops("rig")


# The computer


def test_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(doctor_storage.tempfile, "TemporaryFile", refuse)
    finding = look("disk", tmp_path)
    assert [finding.stops(p) for p in doctor.PURPOSES] == [True, True, True]
    assert "Read-only file system" in finding.found
    assert "--path" in finding.remedy


@pytest.mark.parametrize(
    ("free_gb", "speed", "stopped"),
    [
        (0.1, 900.0, ["run", "lidar", "rig"]),
        (6.0, 900.0, ["rig"]),
        (900.0, 8.0, ["rig"]),
        (900.0, 60.0, []),
        (900.0, 900.0, []),
    ],
)
def test_disks_that_are_full_or_slow(free_gb, speed, stopped, tmp_path, monkeypatch):
    monkeypatch.setattr(doctor_storage.shutil, "disk_usage", lambda _: SimpleNamespace(free=free_gb * 1e9))
    monkeypatch.setattr(doctor_storage, "write_speed", lambda *_: speed)
    finding = look("disk", tmp_path)
    assert [p for p in doctor.PURPOSES if finding.stops(p)] == stopped
    assert bool(finding.remedy) == bool(stopped)
    assert ("not raw" in finding.found) == (speed == 60.0)


def test_the_trial_of_the_disk_is_bounded_and_leaves_nothing(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(doctor_storage.os, "fsync", lambda _: written.append(1))
    assert doctor_storage.write_speed(tmp_path) > 0
    assert len(written) <= 16
    written.clear()
    monkeypatch.setattr(doctor_storage, "_SECONDS", 0.0)
    doctor_storage.write_speed(tmp_path)
    assert len(written) == 1  # a slow disk is left alone after the first step
    assert list(tmp_path.iterdir()) == []


def test_what_a_recording_needs_is_that_of_the_default_rig():
    needs = doctor_storage.recording_needs()
    assert needs.h264_mb_s == pytest.approx(2.5 + 3.4)
    assert needs.raw_mb_s == pytest.approx(2048 * 1088 * 60 / 1e6 + 3.4)
    assert needs.free_gb == pytest.approx(5.0 + 5.9 * 600 / 1000)


def test_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("ACINO_FTE_CACHE", str(tmp_path / "cache"))
    assert look("cache", tmp_path).state == "ok"
    assert list((tmp_path / "cache").iterdir()) == []
    (tmp_path / "file").touch()
    monkeypatch.setenv("ACINO_FTE_CACHE", str(tmp_path / "file"))
    finding = look("cache", tmp_path)
    assert finding.state == "failed"
    assert not any(finding.stops(p) for p in doctor.PURPOSES)
    assert "ACINO_FTE_CACHE" in finding.remedy


@pytest.mark.parametrize(("available", "state"), [(300, "failed"), (1500, "note"), (9000, "ok")])
def test_memory(available, state, tmp_path):
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc" / "meminfo").write_text(f"MemTotal: 16000000 kB\nMemAvailable: {available}000 kB\n")
    finding = look("memory", tmp_path)
    assert finding.state == state
    assert bool(finding.remedy) == (state != "ok")
    (tmp_path / "proc" / "meminfo").write_text("nonsense")
    assert look("memory", tmp_path).state in ("ok", "note")


def test_the_clock(tmp_path, monkeypatch):
    for told, state in ((True, "ok"), (False, "note"), (None, "ok")):
        monkeypatch.setattr(doctor_machine, "is_synchronised", lambda told=told: told)
        finding = look("clock", tmp_path)
        assert finding.state == state
        assert not finding.stops("rig")
    monkeypatch.setattr(doctor_machine, "monotonic_step", lambda: 0.015)
    assert look("clock", tmp_path).stops("rig")
    monkeypatch.undo()
    monkeypatch.setattr(doctor_machine.time, "time", lambda: 86400.0 * 20)  # a clock without a battery
    finding = look("clock", tmp_path)
    assert finding.stops("rig")
    assert "1970-01-21" in finding.found
    assert "date -u -s" in finding.remedy


def test_a_clock_of_which_nothing_tells_does_not_fail(monkeypatch):
    def refuse(*_args, **_kwargs):
        raise OSError("not permitted")

    monkeypatch.setattr(doctor_machine.ctypes, "CDLL", refuse)
    monkeypatch.setattr(doctor_machine.shutil, "which", lambda _: "/bin/timedatectl")
    monkeypatch.setattr(doctor_machine.subprocess, "run", lambda *_, **__: SimpleNamespace(stdout="yes\n"))
    assert doctor_machine.is_synchronised() is True
    monkeypatch.setattr(doctor_machine.subprocess, "run", refuse)
    assert doctor_machine.is_synchronised() is None


def test_the_monotonic_clock_of_this_computer():
    assert 0.0 < doctor_machine.monotonic_step() < 0.02


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "powersave"}, "performance"),
        ({"sys/devices/system/cpu/cpu1/thermal_throttle/core_throttle_count": "7"}, "shade"),
        ({"sys/class/thermal/thermal_zone0/temp": "91000"}, "slows down"),
        ({"sys/class/thermal/thermal_zone0/temp": "45000"}, ""),
        ({"sys/class/thermal/thermal_zone0/temp": "nonsense"}, ""),
    ],
)
def test_processors(files, words, tmp_path):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(text + "\n")
    finding = look("processor", tmp_path)
    assert finding.state == ("note" if words else "ok")
    assert words in finding.remedy
