"""Devices and what reaches them: video encoders, pages in the browser, serial ports, GPIO, drivers."""

from __future__ import annotations

import os
import platform
import re
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from acino_fte.doctor import LIDAR, RIG, Finding, Surroundings

_EXTRA = 'pip install --force-reinstall "acino-fte[rig]"'
_PLUGGED = re.compile(r"tty(USB|ACM|AMA|THS|GS)\d+$")  # by USB, or the pins of a small computer
_GROUP = "sudo usermod -aG {group} $USER, then log out and in again"


def look_at_codecs(around: Surroundings) -> Finding:
    """H.264: libx264 for every computer, hardware where there is some."""
    both = LIDAR | RIG
    answer = around.answers["codecs"]
    if answer.fault:
        return Finding("failed", f"cannot be tried: {answer.fault}", 'pip install "acino-fte[rig]"', both)
    works, faults = answer.value["works"], answer.value["faults"]
    hardware = [name for name in works if name != "libx264"]
    if "libx264" not in works:
        return Finding("failed", f"libx264 does not work: {faults['libx264']}", _EXTRA, both, answer.value)
    by = f"hardware: {', '.join(hardware)}" if hardware else "no hardware encoder: the processor encodes"
    return Finding("ok", f"libx264 works; {by}", matters=both, details=answer.value)


def look_at_page(around: Surroundings) -> Finding:  # noqa: ARG001 - every check takes it
    """Can a page be served on 127.0.0.1? A port is opened, reached, and closed."""
    remedy = "allow connections to 127.0.0.1 in the firewall, and give this computer its loopback interface"
    try:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            port = listener.getsockname()[1]
            listener.settimeout(1.0)
            with socket.create_connection(("127.0.0.1", port), timeout=1.0) as there:
                here, _ = listener.accept()
                with here:
                    here.settimeout(1.0)
                    there.sendall(b"doctor")
                    heard = here.recv(16)
    except OSError as error:
        return Finding("failed", f"127.0.0.1 cannot be served: {error.strerror or error}", remedy, LIDAR)
    if heard != b"doctor":
        return Finding("failed", "127.0.0.1 answers with something else", remedy, LIDAR)
    return Finding("ok", "127.0.0.1 can be served", matters=LIDAR)


def look_at_serial(around: Surroundings) -> Finding:
    """Serial ports that something is plugged into, and whether they may be opened."""
    answer = around.answers["serial"]
    if answer.fault:
        return Finding("failed", f"cannot be listed: {answer.fault}", 'pip install "acino-fte[rig]"', RIG)
    ports = [
        p for p in answer.value["ports"] if p["usb"] or _PLUGGED.search(p["device"]) or _named(p["device"])
    ]
    details = {"ports": ports, "others": len(answer.value["ports"]) - len(ports)}
    if not ports:
        remedy = "plug in the microcontroller (cable with data lines?); a rig without motors needs none"
        return Finding("note", "nothing is plugged in", remedy, RIG, details)
    closed = [p["device"] for p in ports if not _may_open(p["device"])]
    text = ", ".join(
        f"{p['device']} ({p['what']})" if p["what"] not in ("", "n/a") else p["device"] for p in ports
    )
    if closed:
        text = f"no permission for {', '.join(closed)}"
        return Finding("failed", text, _permission(closed[0], "dialout"), RIG, details)
    return Finding("ok", text, matters=RIG, details=details)


def _named(device: str) -> bool:
    """Windows and macOS list only what is there."""
    return not device.startswith("/dev/tty") or sys.platform == "darwin"


def _may_open(device: str) -> bool:
    return not device.startswith("/dev/") or os.access(device, os.R_OK | os.W_OK)


def _permission(device: str, usual: str) -> str:
    """How to get access to a device: by its group, or by logging in again where that has been done."""
    with suppress(ImportError, OSError, KeyError):
        import grp
        import pwd

        group = grp.getgrgid(Path(device).stat().st_gid)
        user = pwd.getpwuid(os.getuid()).pw_name
        if group.gr_gid not in os.getgroups() and user in group.gr_mem:
            return f"log out and in again: you are in the group {group.gr_name}, but this session is older"
        if group.gr_name != "root":
            return _GROUP.format(group=group.gr_name)
    return _GROUP.format(group=usual)


def look_at_gpio(around: Surroundings) -> Finding:
    """GPIO chips, for encoders and motors on the computer's own pins."""
    if platform.system() != "Linux":
        return Finding(
            "note", "only Linux has it", "needed for encoders on the computer's own pins only", RIG
        )
    answer = around.answers["gpio"]
    if answer.fault:
        return Finding("failed", f"cannot be tried: {answer.fault}", 'pip install "acino-fte[rig]"', RIG)
    chips: list[dict[str, Any]] = answer.value["chips"]
    if not chips:
        remedy = "needed for encoders on the computer's own pins only; a microcontroller does without"
        return Finding("note", "no chip", remedy, RIG, answer.value)
    closed = [chip for chip in chips if chip["fault"]]
    if len(closed) == len(chips):
        text = f"{closed[0]['device']} cannot be opened: {closed[0]['fault']}"
        return Finding("failed", text, _permission(closed[0]["device"], "gpio"), RIG, answer.value)
    text = ", ".join(f"{Path(c['device']).name} ({c['lines']} lines)" for c in chips if not c["fault"])
    return Finding("ok", text, matters=RIG, details=answer.value)


def look_at_devices(around: Surroundings) -> Finding:
    """The devices of the ``rig.yaml`` here: has each a driver?"""
    answer = around.answers["devices"]
    if answer.fault:
        return Finding("failed", f"cannot be tried: {answer.fault}", 'pip install "acino-fte[rig]"', RIG)
    found = answer.value
    if found["faults"]:
        remedy = found["remedy"] or "install the driver anew"
        return Finding("failed", "; ".join(found["faults"]), remedy, RIG, found)
    if not found["file"]:
        remedy = "acino-fte rig plan --init writes one; name the drivers of your devices in it"
        return Finding(
            "note", "no rig.yaml in this folder: recordings can be simulated only", remedy, RIG, found
        )
    simulated = [name for name, device in found["devices"].items() if device == "simulated"]
    if simulated:
        remedy = "name the drivers of real devices in rig.yaml, after device:"
        return Finding("note", f"simulated: {', '.join(simulated)}", remedy, RIG, found)
    text = ", ".join(f"{name}: {device}" for name, device in found["devices"].items())
    return Finding("ok", text, matters=RIG, details=found)
